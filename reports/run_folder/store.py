"""How does a run reach the disk so that a killed one can go on? One Parquet part per model and table, and run.json.

A part is written under a temporary name, flushed to the disk and renamed. The part in ``models`` comes last and is the
mark that the model is finished: a model without it is audited again. docs/decisions/0002-run-folder.md says which
commands may write into an existing folder.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import pyarrow as pa
import pyarrow.parquet as pq
from filelock import FileLock, Timeout

from sfm_audit.loaders.datasets.discover import ModelRef
from sfm_audit.loaders.datasets.input_state import InputState
from sfm_audit.loaders.paths.locations import real_location
from sfm_audit.reports.errors import OutputError, RunFolderError
from sfm_audit.reports.run_folder.disk import flush_folder, write_whole, writing

TOOL: Final = "sfm-audit"
TABLES: Final = ("images", "cameras", "models")  # in the order in which a model's parts are written
METADATA_KEY: Final = b"sfm_audit"
COUNTED: Final = ("num_images", "num_accepted", "num_rejected", "num_undetermined")
OBSERVATIONS: Final = "observations"  # only where it was asked for; written first
_ALL_TABLES: Final = (OBSERVATIONS, *TABLES)
_OWN_FILES: Final = frozenset({"run.json", ".lock", *_ALL_TABLES})


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What a run folder is bound to: the tool's version, the config, and the PATHs of the command.

    empty_paths: those of ``paths`` in which no model was found; a folder is not bound to them.
    observations: whether a model is finished only with its table of observations.
    """

    version: str
    config: Mapping[str, Any]
    paths: Sequence[str]
    empty_paths: frozenset[str] = frozenset()
    observations: bool = False


@dataclass(frozen=True, slots=True)
class _Part:
    """What a finished model says about itself in the metadata of its parts."""

    version: str
    config: Mapping[str, Any]
    labels: Mapping[str, str]
    state: InputState
    counts: Mapping[str, int]
    seconds: float


@dataclass(frozen=True, slots=True)
class _Entry:
    """What run.json says about a finished model; all that is kept of it in memory, for a run may have 100,000."""

    labels: Mapping[str, str]
    num_bytes: int
    digest: str
    counts: tuple[int, ...]
    seconds: float

    @classmethod
    def of(cls, part: _Part, ref: ModelRef) -> _Entry:
        """Keep what is needed of a part."""
        counts = tuple(part.counts[name] for name in COUNTED)
        return cls(_labels(ref), part.state.num_bytes, part.state.digest, counts, part.seconds)

    def line(self, key: str) -> bytes:
        """Return the model's line among the inputs of run.json."""
        fields = {
            **self.labels,
            "part": f"part-{key}.parquet",
            "num_bytes": self.num_bytes,
            "sha256": self.digest,
            "seconds": round(self.seconds, 3),
        }
        return json.dumps(fields).encode()


class RunStore:
    """An open run folder; one process at a time.

    Use as a context manager. Methods raise OutputError when the operating system refuses to write; parts that were
    finished before stay.
    """

    def __init__(self, folder: Path, settings: RunSettings) -> None:
        self.folder = folder
        self._settings = settings
        self._paths: list[dict[str, str]] = []
        self._entries: dict[str, _Entry] = {}
        self._lock = FileLock(folder / ".lock", timeout=0)

    def __enter__(self) -> Self:
        """Lock the folder and make it ready.

        Raises
        ------
        RunFolderError
            The folder is in use, holds another run, or is not a run folder.
        OutputError
            It cannot be made or written.
        """
        _refuse_foreign_folder(self.folder)
        with writing(self.folder):
            for name in self._wanted:
                (self.folder / name).mkdir(parents=True, exist_ok=True)
        self._acquire()
        try:
            self._paths = self._bind()
            self._remove_temporary_files()
            self._write_run_json("running", {})
        except BaseException:
            self._lock.release()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let other runs in; what was written stays."""
        self._lock.release()

    def refuse_to_forget(self, left_out: Iterable[ModelRef]) -> None:
        """Raise RunFolderError where the folder holds one of the models that a command leaves out."""
        for ref in left_out:
            if self._path("models", ref.key).exists():
                problem = f"holds {ref.scene}/{ref.component} ({ref.model_path}), which this command leaves out"
                advice = "choose that one too, choose another -o, or remove the folder"
                raise RunFolderError(self.folder, problem, advice)

    def finished(self, ref: ModelRef) -> InputState | None:
        """Return the input a model was finished with, or None when this run has to audit it."""
        part = _read_part(self._path("models", ref.key))
        if part is None or not all(self._path(name, ref.key).exists() for name in self._wanted):
            return None
        if (part.version, part.config, part.labels) != (self._settings.version, self._config(), _labels(ref)):
            return None
        self._entries[ref.key] = _Entry.of(part, ref)
        return part.state

    def write(self, ref: ModelRef, state: InputState, tables: Mapping[str, pa.Table], seconds: float) -> None:
        """Write the parts of one model; the ``models`` part, which has one row, last."""
        self.drop(ref.key)
        row = tables["models"].select(list(COUNTED))
        counts = {name: int(row[name][0].as_py()) for name in COUNTED}
        part = _Part(self._settings.version, self._config(), _labels(ref), state, counts, seconds)
        metadata = {METADATA_KEY: json.dumps(asdict(part)).encode()}
        for name in self._wanted:
            buffer = pa.BufferOutputStream()
            pq.write_table(tables[name].replace_schema_metadata(metadata), buffer)
            write_whole(self._path(name, ref.key), [buffer.getvalue()])
        self._entries[ref.key] = _Entry.of(part, ref)

    def drop(self, key: str) -> None:
        """Remove a model's parts, its mark of being finished first."""
        self._entries.pop(key, None)
        for name in reversed(_ALL_TABLES):
            path = self._path(name, key)
            with writing(path):
                if path.exists():
                    path.unlink()
                    flush_folder(path.parent)  # no later part may reach the disk before the mark is gone from it

    def finish(self, keep: Iterable[str] | None, failures: Sequence[tuple[str, str]], seconds: float) -> None:
        """Complete run.json, after removing all models but those in ``keep`` (None: remove nothing).

        failures: (model path or PATH, message).    seconds: how long the run took.
        """
        if keep is not None:
            wanted = set(keep)
            for path in sorted((self.folder / "models").glob("part-*.parquet")):
                key = path.stem.removeprefix("part-")
                if key not in wanted:
                    self.drop(key)
        entries = self._entries
        totals = {name: sum(entry.counts[i] for entry in entries.values()) for i, name in enumerate(COUNTED)}
        content = {
            "counts": {"num_models": len(entries), **totals, "num_failures": len(failures)},
            "failures": [{"location": location, "message": message} for location, message in failures],
            "seconds": round(seconds, 3),
        }
        order = sorted(entries, key=lambda key: entries[key].labels["model_path"])
        self._write_run_json("complete", content, (entries[key].line(key) for key in order))

    @property
    def _wanted(self) -> tuple[str, ...]:
        """The tables of a finished model, in the order in which they are written."""
        return _ALL_TABLES if self._settings.observations else TABLES

    def _path(self, table: str, key: str) -> Path:
        return self.folder / table / f"part-{key}.parquet"

    def _acquire(self) -> None:
        try:
            self._lock.acquire()
        except Timeout:  # an OSError too, so it stands first
            raise RunFolderError(self.folder, "another run is writing here", "wait, or choose another -o") from None
        except OSError as error:
            raise OutputError(self.folder, error.strerror or str(error)) from error

    def _config(self) -> dict[str, Any]:
        return dict(self._settings.config)

    def _bind(self) -> list[dict[str, str]]:
        """Refuse a folder that holds another run; return the PATHs that it is bound to from now on."""
        old = _read_run_json(self.folder) or {"config": self._config(), "paths": []}
        mine = self._config()
        for name in sorted({*old["config"], *mine}):
            if old["config"].get(name) != mine.get(name):
                problem = f"holds a run with {name} = {old['config'].get(name)}, not {mine.get(name)}"
                raise RunFolderError(self.folder, problem, "choose another -o, or remove the folder")
        named = {real_location(path): path for path in self._settings.paths}
        bound = {path["real"]: path["given"] for path in old["paths"]}
        lost = [given for real, given in bound.items() if real not in named]
        if lost:
            problem = f"holds a run over {lost[0]}, which this command leaves out"
            raise RunFolderError(self.folder, problem, "name that PATH too, choose another -o, or remove the folder")
        return [
            {"given": given, "real": real}
            for real, given in named.items()
            if given not in self._settings.empty_paths or real in bound
        ]

    def _remove_temporary_files(self) -> None:
        with writing(self.folder):
            for folder in (self.folder, *(self.folder / name for name in _ALL_TABLES)):
                for path in folder.glob(".tmp-*"):
                    path.unlink()

    def _write_run_json(self, status: str, content: Mapping[str, Any], inputs: Iterable[bytes] | None = None) -> None:
        settings = self._settings
        head = {"tool": TOOL, "version": settings.version, "status": status}
        bound = {"config": self._config(), "paths": self._paths}
        text = json.dumps({**head, **bound, **content}, indent=1)
        write_whole(self.folder / "run.json", _with_inputs(text.encode(), inputs))


def _labels(ref: ModelRef) -> dict[str, str]:
    return {"dataset": ref.dataset, "scene": ref.scene, "component": ref.component, "model_path": ref.model_path}


def _refuse_foreign_folder(folder: Path) -> None:
    if not folder.is_dir() or (folder / "run.json").exists():
        return
    with writing(folder):
        names = sorted(path.name for path in folder.iterdir())
    foreign = [name for name in names if name not in _OWN_FILES and not name.startswith(".tmp-")]
    if foreign:
        problem = f"is not a run folder and not empty ({foreign[0]!r} is in it)"
        raise RunFolderError(folder, problem, "choose a new folder with -o")


def _read_run_json(folder: Path) -> dict[str, Any] | None:
    path = folder / "run.json"
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except ValueError:
        content = None
    if not isinstance(content, dict) or content.get("tool") != TOOL or not {"config", "paths"} <= content.keys():
        raise RunFolderError(folder, "its run.json was not written by sfm-audit", "choose a new folder with -o")
    return content


def _read_part(path: Path) -> _Part | None:
    """Return what a part says about itself; None when it is missing or not one of ours."""
    try:
        metadata = pq.read_metadata(path).metadata or {}
        fields = json.loads(metadata[METADATA_KEY])
        return _Part(**{**fields, "state": InputState(**fields["state"])})
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _with_inputs(text: bytes, inputs: Iterable[bytes] | None) -> Iterator[bytes]:
    """Yield a JSON object, and before its last brace the member ``inputs``, an element per line."""
    if inputs is None:
        yield text
        return
    yield text.removesuffix(b"\n}") + b',\n "inputs": ['
    separator = b"\n  "
    for line in inputs:
        yield separator + line
        separator = b",\n  "
    yield b"\n ]\n}"
