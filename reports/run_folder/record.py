"""What does a run folder say about itself? run.json and the lines of manifest.jsonl, checked before they are believed.

The only place where their content is interpreted. Limits on size and nesting come before the meaning.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sfm_audit.reports.errors import DamagedRunError, RunFolderError
from sfm_audit.reports.run_folder.disk import RUN_JSON, read_plain

TOOL: Final = "sfm-audit"
MAX_RUN_JSON_BYTES: Final = 32_000_000  # 100,000 inputs that cannot be read
_SHOWN: Final = 80

INPUT_KINDS: Final = frozenset({"unreadable", "too_large"})
"""Kinds of failures that lie in the input; the others are bugs and limits that stopped a model."""

_Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_Key = Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
_Table = Annotated[str, Field(pattern=r"^(images|cameras|models|observations)$")]
_Count = Annotated[int, Field(ge=0, le=2**62)]
_Text = Annotated[str, Field(max_length=100_000)]
_Path = Annotated[str, Field(max_length=200)]
_Setting = str | bool | int | float | None


class _Record(BaseModel):
    """Unknown names are passed over: a later version may say more."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False, protected_namespaces=())


class PathRecord(_Record):
    """A PATH of the command: as given, and its real location. Data: nothing is opened because it stands here."""

    given: _Text
    real: _Text


class FailureRecord(_Record):
    """An input without rows. kind: unreadable, too_large, memory, time, died or error; report: file below RUN."""

    location: _Text
    message: _Text
    kind: str = Field(default="unreadable", max_length=40)
    report: str | None = Field(default=None, max_length=100)


class KernelsRecord(_Record):
    """How numbers were computed: name, compiled or numpy, in the command's own process, and why.

    sources: hash of the kernels' sources.    models: how many by which path, named as in manifest.jsonl.
    """

    name: str = Field(max_length=40)
    reason: _Text = ""
    sources: str | None = Field(default=None, max_length=100)
    models: dict[_Path, _Count] = Field(default_factory=dict)


class ManifestRecord(_Record):
    """Which manifest.jsonl belongs to this run.json: the number of its lines and the SHA-256 of its bytes."""

    num_models: _Count
    sha256: _Sha256


class OldInputRecord(_Record):
    """A model of a run folder from before there was a manifest; the hash is its input's."""

    dataset: _Text
    scene: _Text
    component: _Text
    model_path: _Text
    part: Annotated[str, Field(pattern=r"^part-[0-9a-f]{16}\.parquet$")]
    num_bytes: _Count
    sha256: _Text


class ConfigRecord(_Record):
    """The settings that the tables were made with; those that are read here are named, the others are plain values."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, _Setting]

    noise: _Text
    points: _Text = "in-sample"
    policy: _Text
    min_effect: str = Field(pattern=r"^(\d{1,30}(\.\d{0,30})?|\.\d{1,30})(px|sigma)$")
    alpha: float = Field(gt=0, lt=1)
    pose_offset_threshold_px: float = Field(default=0.5, gt=0)


class RunRecord(_Record):
    """The content of run.json."""

    tool: Literal["sfm-audit"]
    version: str = Field(max_length=100)
    status: Literal["running", "complete"]
    config: ConfigRecord
    paths: tuple[PathRecord, ...] = Field(fail_fast=True)  # a million wrong ones are one error
    counts: dict[str, _Count] = Field(default_factory=dict)
    failures: tuple[FailureRecord, ...] = Field(default=(), fail_fast=True)
    seconds: float = Field(default=0.0, ge=0)
    finished: str | None = Field(default=None, max_length=40)
    command: _Text | None = None
    kernels: KernelsRecord | None = None
    manifest: ManifestRecord | None = None
    inputs: tuple[Any, ...] | None = None  # before there was a manifest


class PartRecord(_Record):
    """Number of rows, bytes and SHA-256 of one part."""

    rows: _Count
    num_bytes: _Count
    sha256: _Sha256


class ModelRecord(_Record):
    """One line of manifest.jsonl: a model, the state of its input, its parts by table, and which path numbers took."""

    key: _Key
    dataset: _Text
    scene: _Text
    component: _Text
    model_path: _Text
    num_bytes: _Count
    sha256: _Text
    seconds: float = Field(ge=0)
    parts: dict[_Table, PartRecord]
    computed_by: _Path = ""

    @property
    def labels(self) -> Mapping[str, str]:
        """The columns that name the model in every table."""
        return {name: getattr(self, name) for name in ("dataset", "scene", "component", "model_path")}


def old_models(folder: Path, record: RunRecord) -> tuple[ModelRecord, ...]:
    """Return the models of a run folder from before there was a manifest: without parts, whose hashes nobody knows."""
    try:
        inputs = [OldInputRecord.model_validate(each) for each in record.inputs or ()]
    except ValidationError as error:
        raise DamagedRunError(folder, f"the inputs in its run.json are damaged ({first_problem(error)})") from error
    return tuple(
        ModelRecord(
            key=old.part.removeprefix("part-").removesuffix(".parquet"),
            **old.model_dump(exclude={"part"}),
            seconds=0.0,
            parts={},
        )
        for old in inputs
    )


def read_run_json(folder: Path) -> RunRecord:
    """Read and check run.json.

    Raises
    ------
    FileNotFoundError, NotADirectoryError
        There is none.
    RunFolderError
        It cannot be read, was not written by sfm-audit, or is damaged; one line says where.
    """
    advice = "choose another folder; run goes on with what is intact after run.json was removed"
    try:
        content = read_plain(folder / RUN_JSON, MAX_RUN_JSON_BYTES)
    except (FileNotFoundError, NotADirectoryError):
        raise
    except OSError as error:
        raise RunFolderError(folder, f"its run.json cannot be read ({error.strerror})", advice) from error
    try:
        return RunRecord.model_validate_json(content)
    except ValidationError as error:
        problem = f"its run.json was not written by sfm-audit, or is damaged ({first_problem(error)})"
        raise RunFolderError(folder, problem, advice) from error


def first_problem(error: ValidationError) -> str:
    """Say in a few words where a record is wrong, without repeating what stands there."""
    detail: Any = error.errors(include_url=False, include_context=False, include_input=False)[0]
    where = ".".join(str(part) for part in detail["loc"])[:_SHOWN]
    what = str(detail["msg"])[:_SHOWN]
    return f"{where}: {what}" if where else what
