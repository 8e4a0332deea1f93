"""Ways in which a run folder is damaged or made up; each takes a copy of a run and a random generator."""

import hashlib
import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

HOSTILE: tuple[Any, ...] = (
    *(None, True, 0, -1, 2**70, 1e308, "", "x", "\x1b[31m", "s3://bucket/model?endpoint_override=h", "../../etc", "\0"),
    *([], {}, [None], [1], {"a": None}, [[[[]]]], "y" * 3000, ["reject"], {"given": "x", "real": "//host/share"}),
)


def parts(run: Path) -> list[Path]:
    return sorted(run.glob("*/part-*.parquet"))


def forge_manifest(run: Path, change: Callable[[dict[str, Any]], Any] = lambda _: None) -> None:
    """Make manifest and run.json say what lies there, as somebody could who wants to be believed."""
    lines = []
    for line in (run / "manifest.jsonl").read_text().splitlines():
        model = json.loads(line)
        for table, part in model["parts"].items():
            path = run / table / f"part-{model['key']}.parquet"
            if path.is_file():
                content = path.read_bytes()
                part |= {"num_bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
                try:
                    part["rows"] = pq.read_metadata(path).num_rows
                except (OSError, pa.ArrowException):
                    part["rows"] = 0
        change(model)
        lines.append(json.dumps(model) + "\n")
    content = "".join(lines).encode()
    (run / "manifest.jsonl").write_bytes(content)
    info = json.loads((run / "run.json").read_text())
    info["manifest"] = {"num_models": len(lines), "sha256": hashlib.sha256(content).hexdigest()}
    (run / "run.json").write_text(json.dumps(info))


def places(value: Any) -> list[tuple[Any, Any]]:
    """Every container and key of a JSON value."""
    items: list[tuple[Any, Any]] = list(value.items()) if isinstance(value, dict) else []
    items = list(enumerate(value)) if isinstance(value, list) else items
    return [*((value, key) for key, _ in items), *(place for _, inner in items for place in places(inner))]


def set_somewhere(value: Any, rng: random.Random) -> None:
    container, key = rng.choice(places(value))
    if isinstance(container, dict) and rng.random() < 0.3:
        del container[key]
    else:
        container[key] = rng.choice(HOSTILE)


# files of the run that are cut, overwritten, exchanged or made into something else


def _any_file(run: Path, rng: random.Random) -> Path:
    return rng.choice([run / "run.json", run / "manifest.jsonl", *parts(run), *parts(run)])


def cut(run: Path, rng: random.Random) -> None:
    path = _any_file(run, rng)
    content = path.read_bytes()
    path.write_bytes(content[: rng.choice([0, 1, len(content) // 2, len(content) - 1, rng.randrange(len(content))])])


def flip(run: Path, rng: random.Random) -> None:
    path = _any_file(run, rng)
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice([1, 1, 8])):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)


def zero(run: Path, rng: random.Random) -> None:
    path = _any_file(run, rng)
    content = bytearray(path.read_bytes())
    start = rng.randrange(len(content))
    size = min(rng.choice([16, 512, 4096]), len(content) - start)
    content[start : start + size] = bytes(size)
    path.write_bytes(content)


def grow(run: Path, rng: random.Random) -> None:
    path = _any_file(run, rng)
    with path.open("ab") as file:
        file.write(rng.choice([b"\n", b"{}\n", b"x" * 1000]))
        if rng.random() < 0.3:
            file.truncate(10**11)  # a hole: no disk is taken


def delete(run: Path, rng: random.Random) -> None:
    _any_file(run, rng).unlink()


def copy_over(run: Path, rng: random.Random) -> None:
    source, target = rng.sample([run / "run.json", run / "manifest.jsonl", *parts(run)], 2)
    shutil.copyfile(source, target)


def copy_part(run: Path, rng: random.Random) -> None:
    table = rng.choice(["images", "cameras", "models"])
    source, target = rng.sample(sorted((run / table).iterdir()), 2)
    shutil.copyfile(source, target)


def add_stranger(run: Path, rng: random.Random) -> None:
    path = rng.choice(parts(run))
    shutil.copyfile(path, path.with_name(f"part-{rng.getrandbits(64):016x}.parquet"))


def special(run: Path, rng: random.Random) -> None:
    path = _any_file(run, rng)
    path.unlink()
    kind = rng.choice(["pipe", "link", "nothing", "zero"])
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to({"link": rng.choice(parts(run)).resolve(), "nothing": "nowhere", "zero": "/dev/zero"}[kind])


def edit_run_json(run: Path, rng: random.Random) -> None:
    info = json.loads((run / "run.json").read_text())
    for _ in range(rng.choice([1, 1, 3])):
        set_somewhere(info, rng)
    (run / "run.json").write_text(json.dumps(info))


def nest_run_json(run: Path, rng: random.Random) -> None:
    text = (run / "run.json").read_text()
    deep = rng.choice(["[" * 100_000 + "]" * 100_000, '{"a":' * 5000 + "1" + "}" * 5000, "[" * 100_000])
    (run / "run.json").write_text(text.replace('"failures": []', f'"failures": {deep}'))


def edit_manifest(run: Path, rng: random.Random) -> None:
    lines = (run / "manifest.jsonl").read_text().splitlines()
    i = rng.randrange(len(lines))
    model = json.loads(lines[i])
    set_somewhere(model, rng)
    lines[i] = json.dumps(model)
    (run / "manifest.jsonl").write_text("".join(line + "\n" for line in lines))


def edit_metadata(run: Path, rng: random.Random) -> None:
    path = rng.choice(parts(run))
    table = pq.ParquetFile(path).read()
    said = json.loads(table.schema.metadata[b"sfm_audit"])
    set_somewhere(said, rng)
    pq.write_table(table.replace_schema_metadata({b"sfm_audit": json.dumps(said).encode()}), path)


DAMAGES = (
    *(cut, flip, zero, grow, delete, copy_over, copy_part, add_stranger, special),
    *(edit_run_json, edit_run_json, nest_run_json, edit_manifest, edit_metadata),
)

# run folders that hang together and were never written by a run


def forge_lines(run: Path, rng: random.Random) -> None:
    forge_manifest(run, lambda model: set_somewhere(model, rng))


def forge_column(run: Path, rng: random.Random) -> None:
    path = rng.choice(parts(run))
    table = pq.ParquetFile(path).read()
    i = rng.randrange(table.num_columns)
    name, n = table.column_names[i], len(table)
    kinds: list[Any] = [
        pa.nulls(n, table.schema.field(i).type),
        pa.array(["reject"] * n),
        pa.array([2**40] * n),
        pa.array([float("nan")] * n),
        pa.array([[None]] * n, pa.list_(pa.string())),
        pa.array([b"\xff"] * n),
    ]
    kind = rng.randrange(len(kinds) + 1)
    changed = table.drop_columns([name]) if kind == len(kinds) else table.set_column(i, name, kinds[kind])
    pq.write_table(changed.replace_schema_metadata(table.schema.metadata), path)
    forge_manifest(run)


def forge_text(run: Path, rng: random.Random) -> None:
    path = rng.choice(parts(run))
    table = pq.ParquetFile(path).read()
    texts = [i for i, field in enumerate(table.schema) if pa.types.is_string(field.type)]
    i = rng.choice(texts)
    words = ["", "\x1b]0;x\x07", "s3://bucket/m?endpoint_override=h&scheme=http", "//host/share/m", "a\0b", "z" * 9000]
    values = pa.array([rng.choice([*words, None]) for _ in range(len(table))], pa.string())
    pq.write_table(table.set_column(i, table.schema.field(i), values), path)
    forge_manifest(run)


def forge_numbers(run: Path, rng: random.Random) -> None:
    path = rng.choice(parts(run))
    table = pq.ParquetFile(path).read()
    numbers = [i for i, field in enumerate(table.schema) if pa.types.is_floating(field.type)]
    for i in rng.sample(numbers, 5):
        values = pa.array([rng.choice([None, 1e308, -1e308, 5e-324, float("inf"), float("nan")])] * len(table))
        table = table.set_column(i, table.schema.field(i), values.cast(pa.float64()))
    pq.write_table(table, path)
    forge_manifest(run)


FORGERIES = (forge_lines, forge_column, forge_text, forge_numbers)
