"""Which processes did a command start? From /proc, because a killed command cannot say."""

from pathlib import Path


def descendants(pid: int) -> list[int]:
    try:
        children = [c for t in Path(f"/proc/{pid}/task").iterdir() for c in (t / "children").read_text("ascii").split()]
    except OSError:
        return []
    return [found for child in map(int, children) for found in (child, *descendants(child))]


def is_worker(pid: int) -> bool:
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
