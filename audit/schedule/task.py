"""One model of a run: what is asked, what comes of it, and how it is loaded and audited, wherever that happens."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import pyarrow as pa

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.engine.model import audit_model
from sfm_audit.audit.kernels import path_taken
from sfm_audit.audit.kernels.threads import num_threads, threads, together
from sfm_audit.audit.schedule.images import image_processes
from sfm_audit.audit.table import ModelLabels
from sfm_audit.loaders import LoadError, ModelRef, open_model
from sfm_audit.loaders.datasets.input_state import InputState, input_stamp, read_input_state
from sfm_audit.loaders.evidence import Given
from sfm_audit.loaders.formats import keypoint_scales_of, verified_pairs_of
from sfm_audit.loaders.model import SparseModel
from sfm_audit.loaders.references.formats import reference_of
from sfm_audit.loaders.references.positions import priors_of
from sfm_audit.loaders.references.state import evidence_state

FailureKind = Literal["unreadable", "too_large", "memory", "time", "died", "error"]


@dataclass(frozen=True, slots=True)
class Failure:
    """A model that was not audited.

    location: as given.    message: one line that says why, and what to do.
    kind: its input cannot be read, or is larger than is loaded; or memory, time, a dead process or a bug ended its
    audit.    report: of a bug, what a developer needs: versions, settings, traceback.
    """

    location: str
    message: str
    kind: FailureKind = "unreadable"
    report: str | None = None


@dataclass(frozen=True, slots=True)
class Limits:
    """What the audit of one model may take; None: as much as it wants.

    input_bytes: a larger model is not loaded.    memory_bytes: of its process as a whole.    seconds: from its start.
    """

    input_bytes: int | None = None
    memory_bytes: int | None = None
    seconds: float | None = None

    @property
    def need_a_process(self) -> bool:
        """Whether the audit has to be watched from another process."""
        return self.memory_bytes is not None or self.seconds is not None


NO_LIMITS: Final = Limits()


@dataclass(frozen=True, slots=True)
class Task:
    """One model to audit.

    known_digest: of the input it was last audited with; None when there is no such audit.
    observations: whether to make the table of observations too.
    num_processes: over which its images are spread.
    num_threads: that compute in each of its kernels, and its joint step beside the rest.
    limits: what its audit may take; enforced from another process.
    """

    ref: ModelRef
    config: AuditConfig
    known_digest: str | None
    observations: bool = False
    num_processes: int = 1
    num_threads: int = 1
    limits: Limits = NO_LIMITS

    @property
    def is_too_large(self) -> bool:
        """Whether the model is not even loaded."""
        return self.limits.input_bytes is not None and self.ref.num_bytes > self.limits.input_bytes


@dataclass(frozen=True, slots=True, eq=False)
class Audited:
    """The tables of one model (by name), the input they were made from, and how long it took.

    computed_by: which path numbers took, compiled kernels and of which sources, or numpy; several with + between them.
    """

    state: InputState
    tables: Mapping[str, pa.Table]
    seconds: float
    computed_by: str = ""

    def __reduce__(self) -> tuple[Callable[..., Audited], tuple[Any, ...]]:
        """Go to another process as Arrow streams: pickling 370 columns one by one takes 13 times as long."""
        streams = {name: _stream_of(table) for name, table in self.tables.items()}
        return _received, (self.state, streams, self.seconds, self.computed_by)


def _received(state: InputState, streams: Mapping[str, bytes], seconds: float, computed_by: str) -> Audited:
    tables = {name: pa.ipc.open_stream(stream).read_all() for name, stream in streams.items()}
    return Audited(state, tables, seconds, computed_by)


def _stream_of(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue().to_pybytes()


@dataclass(frozen=True, slots=True)
class Unchanged:
    """The files were touched, their content is what it was: the finished tables hold."""


Outcome = Audited | Unchanged | Failure
AuditFunction = Callable[[Task], Outcome]


def audit_one(task: Task) -> Outcome:
    """Load and audit one model; a model that cannot be read is a Failure, any other error is raised (see `guarded`)."""
    start = time.perf_counter()
    ref = task.ref
    paths = {str(path_taken())}
    # processes start while the model is read
    with threads(task.num_threads), image_processes(task.num_processes, paths) as spread:
        try:
            content, model = _read(ref.location, task.known_digest)
            if model is None:
                return Unchanged()
            state = replace(content, evidence=evidence_of(ref, task.config))
            scale_px = keypoint_scales_of(model, ref.model_path) if task.config.noise == "keypoint" else None
            given = _given(task, model)
        except LoadError as error:
            return Failure(ref.model_path, str(error))
        except MemoryError:
            return _too_large_to_read(task)
        labels = ModelLabels(ref.dataset, ref.scene, ref.component, ref.model_path)
        audited = audit_model(
            model, task.config, labels, scale_px, observations=task.observations, spread=spread, given=given
        )
    return Audited(state, audited.tables, time.perf_counter() - start, "+".join(sorted(paths)))


def _read(location: str, known_digest: str | None) -> tuple[InputState, SparseModel | None]:
    """Return the state of a model's files and the model; None where the state is known.

    Where nothing is known and two threads may work, the files are hashed while they are read. If they changed meanwhile
    they are read once more, hashed first: the state must never be newer than what was audited.
    """
    if known_digest is None and num_threads() > 1:
        states, models = list[InputState](), list[SparseModel]()
        together(lambda: states.append(read_input_state(location)), lambda: models.append(open_model(location)))
        if input_stamp(location) == states[0].stamp:
            return states[0], models[0]
    state = read_input_state(location)
    return state, None if state.digest == known_digest else open_model(location)


def _given(task: Task, model: SparseModel) -> Given:
    """Read what the settings name besides the model; LoadError where that cannot be read."""
    config, ref = task.config, task.ref
    return Given(
        verified_pairs_of(model, config.database, ref.model_path, ref.below),
        reference_of(model, config.reference, ref.below, ref.scene) if config.reference is not None else None,
        priors_of(model, config.priors, ref.model_path, ref.below) if config.priors is not None else None,
    )


def evidence_of(ref: ModelRef, config: AuditConfig) -> str:
    """Return the state of what the settings name besides the model."""
    return evidence_state(ref.location, ref.below, config.database, config.reference, config.priors)


def too_large(task: Task) -> Failure:
    """Return the failure of a model that is not loaded because of its size."""
    ref, max_bytes = task.ref, task.limits.input_bytes or 0
    got, limit = f"{ref.num_bytes / 1e9:.3g} GB of files", f"at most {max_bytes / 1e9:.3g} GB"
    advice = "raise --max-model-gb where there is memory for it"
    return Failure(ref.model_path, f"{ref.model_path}: expected {limit}, found {got}; {advice}", "too_large")


def _too_large_to_read(task: Task) -> Failure:
    path, size = task.ref.model_path, f"{task.ref.num_bytes / 1e9:.3g} GB of files"
    advice = "run it where there is more, or leave such models out with --max-model-gb"
    return Failure(path, f"{path}: memory was too short to read its {size}; {advice}", "too_large")


def died_twice(task: Task, how: str) -> Failure:
    """Return the failure of a model whose process died a second time."""
    path = task.ref.model_path
    what = f"the process that audited it died twice, the second time with no other beside it ({how})"
    advice = "memory may be short (see dmesg): run it again where there is more, or with --max-model-memory"
    return Failure(path, f"{path}: {what}; {advice}", "died")
