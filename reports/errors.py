"""What can go wrong with an output folder; each message is one line for the user."""

from __future__ import annotations

from pathlib import Path


class RunFolderError(Exception):
    """The folder cannot take this run: in use, another config, or not a run folder."""

    def __init__(self, folder: Path, problem: str, advice: str) -> None:
        super().__init__(folder, problem, advice)
        self.folder = folder
        self.problem = problem
        self.advice = advice

    def __str__(self) -> str:
        return " ".join(f"{self.folder}: {self.problem}; {self.advice}".split())


class DamagedRunError(RunFolderError):
    """What the folder holds is not what a run wrote there; the message names the part."""

    def __init__(self, folder: Path, problem: str) -> None:
        super().__init__(folder, problem, "give its run command again, which audits what is damaged anew")


class OutputError(Exception):
    """The operating system refused to write (no permission, disk full, a file where a folder should be)."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(path, reason)
        self.path = path
        self.reason = reason

    def __str__(self) -> str:
        text = f"{self.path}: cannot be written ({self.reason}); free the disk or choose another -o, then run again"
        return " ".join(text.split())
