"""How does a run reach the disk so that a killed one can go on? A Parquet part per model and table, manifest, run.json.

A part is written under a temporary name, flushed to the disk and renamed. A model's line in the manifest holds rows and
hash of all its parts and is on the disk before the last of them; a model is finished when all its parts are what its
line says. docs/decisions/0002-run-folder.md says which commands may write into an existing folder, and
docs/decisions/0008-run-folder-checked.md what is believed of it.
"""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import pyarrow as pa
import pyarrow.parquet as pq

from sfm_audit.loaders.datasets.discover import ModelRef
from sfm_audit.loaders.datasets.input_state import InputState
from sfm_audit.loaders.paths.locations import real_location
from sfm_audit.reports.errors import DamagedRunError, OutputError, RunFolderError
from sfm_audit.reports.run_folder.disk import RUN_JSON, append_line, flush_folder, write_whole, writing
from sfm_audit.reports.run_folder.lock import LOCK, OWNER, LockedError, RunLock
from sfm_audit.reports.run_folder.manifest import MANIFEST, Manifest, dropped_line, line_of, parsed_or_none, with_hash
from sfm_audit.reports.run_folder.parts import METADATA_KEY, fits, part_path, part_record
from sfm_audit.reports.run_folder.record import TOOL, ModelRecord, PartRecord, read_run_json

TABLES: Final = ("images", "cameras", "models")  # in the order in which a model's parts are written
COUNTED: Final = ("num_images", "num_accepted", "num_rejected", "num_undetermined")
OBSERVATIONS: Final = "observations"  # only where it was asked for; written first
ERRORS: Final = "errors"  # tracebacks of models whose audit was ended by a bug
_ALL_TABLES: Final = (OBSERVATIONS, *TABLES)
_OWN_FILES: Final = frozenset({RUN_JSON, MANIFEST, LOCK, OWNER, ERRORS, *_ALL_TABLES})


class RunFailure(NamedTuple):
    """An input without rows: as in run.json. report: name of the file below RUN that says more."""

    location: str
    message: str
    kind: str = "unreadable"
    report: str | None = None


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What a run folder is bound to: the tool's version, the config, and the PATHs of the command.

    empty_paths: those of ``paths`` in which no model was found; a folder is not bound to them.
    observations: whether a model is finished only with its table of observations.
    kernels: which path numbers take, for run.json; a folder is not bound to it, for the numbers are the same to 1e-9.
    """

    version: str
    config: Mapping[str, Any]
    paths: Sequence[str]
    empty_paths: frozenset[str] = frozenset()
    observations: bool = False
    kernels: Mapping[str, str | None] | None = None


@dataclass(frozen=True, slots=True)
class _Part:
    """What a finished model says about itself in the metadata of its parts."""

    version: str
    config: Mapping[str, Any]
    labels: Mapping[str, str]
    state: InputState
    counts: Mapping[str, int]
    seconds: float
    computed_by: str = ""


@dataclass(frozen=True, slots=True)
class _Entry:
    """A finished model; all that is kept of it in memory, for a run may have 100,000.    line: in the manifest."""

    line: bytes
    counts: tuple[int, ...]
    computed_by: str

    @classmethod
    def of(cls, line: bytes, part: _Part) -> _Entry:
        """Keep what is needed."""
        return cls(line, tuple(part.counts[name] for name in COUNTED), sys.intern(part.computed_by))


class RunStore:
    """An open run folder; one process at a time.    reports: of bugs in this run, by model path: name below RUN.

    Use as a context manager. Methods raise OutputError when the operating system refuses to write; parts that were
    finished before stay.
    """

    def __init__(self, folder: Path, settings: RunSettings) -> None:
        self.folder = folder
        self.reports: dict[str, str] = {}
        self._settings = settings
        self._paths: list[dict[str, str]] = []
        self._claims: dict[str, bytes] = {}
        self._entries: dict[str, _Entry] = {}
        self._lock = RunLock(folder)

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
            self._read_claims()
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
            if part_path(self.folder, "models", ref.key).exists():
                problem = f"holds {ref.scene}/{ref.component} ({ref.model_path}), which this command leaves out"
                advice = "choose that one too, choose another -o, or remove the folder"
                raise RunFolderError(self.folder, problem, advice)

    def finished(self, ref: ModelRef) -> InputState | None:
        """Return the input a model was finished with, or None when this run has to audit it."""
        found = self._intact(ref.key)
        if found is None:
            return None
        line, part = found
        if (part.version, part.config, part.labels) != (self._settings.version, self._config(), _labels(ref)):
            return None
        self._entries[ref.key] = _Entry.of(line, part)
        return part.state

    def write(
        self,
        ref: ModelRef,
        state: InputState,
        tables: Mapping[str, pa.Table],
        seconds: float,
        computed_by: str = "",
    ) -> None:
        """Write the parts of one model; the ``models`` part, which has one row, last."""
        self.drop(ref.key)
        row = tables["models"].select(list(COUNTED))
        counts = {name: int(row[name][0].as_py()) for name in COUNTED}
        part = _Part(self._settings.version, self._config(), _labels(ref), state, counts, seconds, computed_by)
        metadata = {METADATA_KEY: json.dumps(asdict(part)).encode()}
        parts = {}
        for name in self._wanted:
            buffer = pa.BufferOutputStream()
            pq.write_table(tables[name].replace_schema_metadata(metadata), buffer)
            content = buffer.getvalue()
            parts[name] = part_record(content, tables[name].num_rows)
            if name == self._wanted[-1]:  # the line is there before the part that makes the model whole
                line = line_of(_model_record(ref, part, parts))
                append_line(self.folder / MANIFEST, line)
            write_whole(part_path(self.folder, name, ref.key), [content])
        self._claims[ref.key] = line
        self._entries[ref.key] = _Entry.of(line, part)

    def drop(self, key: str) -> None:
        """Remove a model's parts, its mark of being finished first."""
        if self._entries.pop(key, None) or key in self._claims:
            append_line(self.folder / MANIFEST, dropped_line(key))
            self._claims.pop(key, None)
        for path in (*(part_path(self.folder, name, key) for name in reversed(_ALL_TABLES)), self._report(key)):
            with writing(path):
                if os.path.lexists(path):
                    path.unlink()
                    flush_folder(path.parent)  # no later part may reach the disk before the mark is gone from it

    def keep_report(self, ref: ModelRef, text: str) -> None:
        """Write what a bug left behind for a model that has no rows."""
        path = self._report(ref.key)
        with writing(path):
            path.parent.mkdir(exist_ok=True)
        write_whole(path, [text.encode(errors="backslashreplace")])
        self.reports[ref.model_path] = f"{ERRORS}/{path.name}"

    def finish(
        self,
        keep: Iterable[str] | None,
        failures: Iterable[RunFailure],
        seconds: float,
        told: Mapping[str, str] | None = None,
    ) -> None:
        """Complete manifest and run.json, after removing all models but those in ``keep``.

        keep: None: all that are intact.    seconds: how long the run took.
        told: what else run.json should say, for people: ``finished`` (when) and ``command``.
        """
        failures = [RunFailure(*failure) for failure in failures]
        if keep is None:
            for key in self._claims.keys() - self._entries.keys():
                found = self._intact(key)
                if found is not None:
                    self._entries[key] = _Entry.of(*found)
        kept = self._entries.keys() if keep is None else self._entries.keys() & set(keep)
        self._remove_strangers(set(kept), {report for *_, report in failures if report})
        entries = {key: entry for key, entry in sorted(self._entries.items()) if key in kept}
        totals = {name: sum(entry.counts[i] for entry in entries.values()) for i, name in enumerate(COUNTED)}
        pieces, manifest = with_hash(entry.line for entry in entries.values())
        write_whole(self.folder / MANIFEST, pieces)
        by = Counter(entry.computed_by or "unknown" for entry in entries.values())
        kernels = {"kernels": {**(self._settings.kernels or {}), "models": dict(sorted(by.items()))}}
        content = {
            **(kernels if self._settings.kernels else {}),
            "counts": {"num_models": len(entries), **totals, "num_failures": len(failures)},
            "manifest": manifest.model_dump(),
            "failures": [failure._asdict() for failure in failures],
            "seconds": round(seconds, 3),
            **(told or {}),
        }
        self._write_run_json("complete", content)

    @property
    def _wanted(self) -> tuple[str, ...]:
        """The tables of a finished model, in the order in which they are written."""
        return _ALL_TABLES if self._settings.observations else TABLES

    def _report(self, key: str) -> Path:
        return self.folder / ERRORS / f"{key}.txt"

    def _acquire(self) -> None:
        try:
            self._lock.acquire()
        except LockedError as error:
            problem = f"another run is writing here ({error})"
            raise RunFolderError(self.folder, problem, "wait, or choose another -o") from None
        except OSError as error:
            raise OutputError(self.folder, error.strerror or str(error)) from error

    def _read_claims(self) -> None:
        """Keep the lines of the manifest that is there, and nothing of what else stands in it."""
        try:
            self._claims = Manifest.read(self.folder, None).by_key()
        except DamagedRunError:  # no file at all: what has no line is audited again
            self._claims = {}
        write_whole(self.folder / MANIFEST, (line + b"\n" for line in self._claims.values()))

    def _intact(self, key: str) -> tuple[bytes, _Part] | None:
        """Return a model's line and what its parts say, None unless all parts are there as they were written."""
        line = self._claims.get(key, b"")
        model = parsed_or_none(line)
        if model is None or model.key != key or not model.parts.keys() >= set(self._wanted):
            return None
        if not all(fits(part_path(self.folder, name, key), part) for name, part in model.parts.items()):
            return None
        said = _read_part(part_path(self.folder, "models", key))
        if said is None or (said.labels, said.state.digest, said.state.num_bytes) != (
            model.labels,
            model.sha256,
            model.num_bytes,
        ):
            return None
        return line, said

    def _remove_strangers(self, kept: AbstractSet[str], reports: AbstractSet[str]) -> None:
        """Remove parts of models that are not kept, and reports of failures that are none any more."""
        wanted = {f"part-{key}.parquet" for key in kept}
        for name in _ALL_TABLES:
            for path in sorted((self.folder / name).glob("part-*.parquet")):
                if path.name not in wanted:
                    with writing(path):
                        path.unlink()
        for path in sorted((self.folder / ERRORS).glob("*.txt")):
            if f"{ERRORS}/{path.name}" not in reports:
                with writing(path):
                    path.unlink()

    def _config(self) -> dict[str, Any]:
        return dict(self._settings.config)

    def _bind(self) -> list[dict[str, str]]:
        """Refuse a folder that holds another run; return the PATHs that it is bound to from now on."""
        try:
            old = read_run_json(self.folder)
        except FileNotFoundError:
            return self._named(set())
        mine, theirs = self._config(), old.config.model_dump()
        for name in sorted({*theirs, *mine}):
            if theirs.get(name) != mine.get(name):
                problem = f"holds a run with {name} = {theirs.get(name)}, not {mine.get(name)}"
                raise RunFolderError(self.folder, problem, "choose another -o, or remove the folder")
        named = {real_location(path) for path in self._settings.paths}
        lost = [path.given for path in old.paths if path.real not in named]
        if lost:
            problem = f"holds a run over {lost[0]}, which this command leaves out"
            raise RunFolderError(self.folder, problem, "name that PATH too, choose another -o, or remove the folder")
        return self._named({path.real for path in old.paths})

    def _named(self, bound: AbstractSet[str]) -> list[dict[str, str]]:
        """Return the PATHs of the command; one without models only where the folder was bound to it before."""
        named = {real_location(path): path for path in self._settings.paths}
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

    def _write_run_json(self, status: str, content: Mapping[str, Any]) -> None:
        settings = self._settings
        head = {"tool": TOOL, "version": settings.version, "status": status}
        bound = {"config": self._config(), "paths": self._paths}
        text = json.dumps({**head, **bound, **content}, indent=1)
        write_whole(self.folder / RUN_JSON, [text.encode()])


def _labels(ref: ModelRef) -> dict[str, str]:
    return {"dataset": ref.dataset, "scene": ref.scene, "component": ref.component, "model_path": ref.model_path}


def _refuse_foreign_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise OutputError(folder, "it is a file, and a run is a folder")
    if not folder.is_dir():
        return
    for name in (*_ALL_TABLES, ERRORS):
        if (folder / name).is_symlink():
            raise RunFolderError(
                folder, f"its {name} is a link, and parts are written into no other place", "remove it"
            )
    if (folder / RUN_JSON).exists():
        return
    with writing(folder):
        names = sorted(path.name for path in folder.iterdir())
    foreign = [name for name in names if name not in _OWN_FILES and not name.startswith(".tmp-")]
    if foreign:
        problem = f"is not a run folder and not empty ({foreign[0]!r} is in it)"
        raise RunFolderError(folder, problem, "choose a new folder with -o")


def _model_record(ref: ModelRef, part: _Part, parts: Mapping[str, PartRecord]) -> ModelRecord:
    return ModelRecord(
        key=ref.key,
        **part.labels,
        num_bytes=part.state.num_bytes,
        sha256=part.state.digest,
        seconds=round(part.seconds, 3),
        parts=dict(parts),
        computed_by=part.computed_by,
    )


def _read_part(path: Path) -> _Part | None:
    """Return what a part says about itself; None when it is missing or not one of ours."""
    try:
        metadata = pq.read_metadata(path).metadata or {}
        fields = json.loads(metadata[METADATA_KEY])
        return _Part(**{**fields, "state": InputState(**fields["state"])})
    except (OSError, ValueError, KeyError, TypeError):
        return None
