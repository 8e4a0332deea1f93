"""A finished run under other settings: ``--policy``, ``--min-effect``, ``--reason``, ``--severity``."""

from __future__ import annotations

import difflib
import itertools
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import click
import pyarrow as pa
from pydantic import ValidationError

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.settings import read_config
from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.decision.rejections import NAMEABLE_CODES, CountedRejections, counted, verdict_counts
from sfm_audit.audit.decision.triage import CAMERA_COLUMNS, IMAGE_COLUMNS, triage
from sfm_audit.audit.table.words import POLICIES, ReasonCode, Severity
from sfm_audit.loaders.model import FindingCode
from sfm_audit.reports.run_folder.reader import RunReader

AGAIN_OPTIONS: Final = ("policy", "min_effect", "reasons", "at_least")
"""Names of the options, which `Again.of` takes."""
_KEPT_ROWS: Final = 20_000  # images of decided models that stay in memory: a page reads each table several times
_Command = TypeVar("_Command", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Again:
    """How a finished run is to be read. policy, min_effect: None for the run's own."""

    policy: str | None = None
    min_effect: str | None = None
    rejections: CountedRejections = field(default_factory=CountedRejections)

    @classmethod
    def of(
        cls, *, policy: str | None, min_effect: str | None, reasons: Iterable[ReasonCode], at_least: str | None
    ) -> Again:
        """Return what the options say."""
        severity = None if at_least is None else Severity(at_least)
        return cls(policy, min_effect, CountedRejections(frozenset(reasons), severity))

    def __bool__(self) -> bool:
        return self.policy is not None or self.min_effect is not None or bool(self.rejections)

    def read(self, run: RunReader) -> RunReader:
        """Return the run under these settings.

        Raises
        ------
        KnownError
            The settings of the run are of another version, or not valid together with these.
        """
        if not self:
            return run
        own = settings_of(run)
        wanted = {name: value for name, value in (("policy", self.policy), ("min_effect", self.min_effect)) if value}
        return under(run, read_config(None, {**own.model_dump(), **wanted}), self.rejections)


def with_again(command: _Command) -> _Command:
    """Add the options to a verb that reads a finished run; `Again.of` takes what they say."""
    options = (
        click.option(
            "--policy",
            type=click.Choice(tuple(POLICIES)),
            help="Decide again: which verdicts decide.  [default: RUN's]",
        ),
        click.option(
            "--min-effect", metavar="TAU", help="Decide again: misfit that matters, not below RUN's.  [default: RUN's]"
        ),
        click.option(
            "--reason",
            "reasons",
            metavar="CODE",
            callback=_nameable_codes,
            multiple=True,
            help="Only rejections for this reason count, others become undetermined; a witness that leaves images open "
            "rejects where it is named. Repeatable.",
        ),
        click.option(
            "--severity",
            "at_least",
            type=click.Choice([str(each) for each in Severity]),
            help="Only rejections of this severity or worse count, others become undetermined.",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def _nameable_codes(context: click.Context, param: click.Parameter, values: tuple[str, ...]) -> tuple[ReasonCode, ...]:
    """Return the codes; a misspelt one is told what it may have meant."""
    for value in values:
        if value not in NAMEABLE_CODES:
            close = difflib.get_close_matches(value, NAMEABLE_CODES, n=1)
            hint = f"did you mean {close[0]}?" if close else f"one of {', '.join(NAMEABLE_CODES)}"
            raise click.BadParameter(f"{value!r} is no reason that rejects; {hint}", context, param)
    return tuple(ReasonCode(value) for value in values)


GIVEN: Final = ("covariance", "database", "priors", "reference")
"""Settings that say what was looked at besides the model: a run keeps what it was given, whatever decides."""


def settings_of(run: RunReader) -> AuditConfig:
    """Return the settings that a run was made with.

    Raises
    ------
    KnownError
        They are of another version.
    """
    return valid_settings(run.folder, run.info["config"])


def valid_settings(folder: Path, config: Mapping[str, Any]) -> AuditConfig:
    """Return the settings in a run.json; errors as of `settings_of`."""
    try:
        return AuditConfig.model_validate(config)
    except ValidationError as error:
        name = ".".join(str(part) for part in error.errors()[0]["loc"])
        problem = f"{folder}: its setting {name} is of another version; run again to decide under other settings"
        raise KnownError(problem, ExitCode.USAGE) from error


def under(run: RunReader, settings: AuditConfig, rejections: CountedRejections | None = None) -> RunReader:
    """Return the run decided again; tables are decided as they are read, model by model.

    Raises
    ------
    KnownError
        A setting changes what is measured, or is smaller than the run's; or its tables lack numbers that decide.
    """
    own, rule = settings_of(run), rejections or CountedRejections()
    settings = settings.model_copy(update={name: getattr(own, name) for name in GIVEN})
    if settings == own and not rule:
        return run
    changed = [
        f"{name} {value} instead of {getattr(own, name)}"
        for name, value in settings.model_dump().items()
        if value != getattr(own, name)
    ]
    words = "; ".join(part for part in (", ".join(changed), str(rule)) if part)
    decided = _Decided(run.folder, own, settings, rule)
    again = run.revised(settings.model_dump(), decided, words)
    for _ in itertools.islice(again.rows("images", ["verdict"]), 1):  # says at once what no model allows
        pass
    return again


@dataclass(slots=True)
class _Decided:
    """The revision of a run: each model is decided when it is read, the last ones are kept."""

    folder: Path
    own: AuditConfig
    settings: AuditConfig
    rule: CountedRejections
    _kept: OrderedDict[str, pa.Table] = field(default_factory=OrderedDict)

    def __call__(self, table: str, key: str, read: Callable[[str], pa.Table]) -> pa.Table:
        """Return a table of the model as it is under the settings."""
        from sfm_audit.audit.decision.from_table import RedecisionError, redecide_cameras  # noqa: PLC0415 - SciPy

        if table == "images":
            return self._images(key, read)
        try:
            if table == "cameras":
                return redecide_cameras(read(table), read("images"), self.settings, run=self.own)
            return self._models(read(table), key, read)
        except (KeyError, TypeError, ArithmeticError, RedecisionError) as error:
            raise self._problem(error) from error

    def _images(self, key: str, read: Callable[[str], pa.Table]) -> pa.Table:
        from sfm_audit.audit.decision.from_table import redecide  # noqa: PLC0415 - SciPy

        if key not in self._kept:
            written = read("images")
            try:
                again = redecide(written, self.settings, run=self.own) if self.settings != self.own else written
                self._kept[key] = counted(again, self.rule)
            except (KeyError, TypeError, ValueError, ArithmeticError) as error:
                raise self._problem(error) from error
            while len(self._kept) > 1 and sum(each.num_rows for each in self._kept.values()) > _KEPT_ROWS:
                self._kept.popitem(last=False)
        return self._kept[key]

    def _models(self, models: pa.Table, key: str, read: Callable[[str], pa.Table]) -> pa.Table:
        images, cameras = self._images(key, read), self("cameras", key, read)
        models = _with_counts(models, verdict_counts(images))
        if "diagnoses" not in models.column_names:
            return models
        rows = images.select(list(IMAGE_COLUMNS)).to_pylist(), cameras.select(list(CAMERA_COLUMNS)).to_pylist()
        found = [
            [asdict(each) for each in triage(*rows, str(row["model_path"]), parts_disagree=_is_torn(row["findings"]))]
            for row in models.select(["model_path", "findings"]).to_pylist()
        ]
        at = models.column_names.index("diagnoses")
        kind = models.schema.field(at)
        return models.set_column(at, kind, pa.array(found, type=kind.type))

    def _problem(self, error: Exception) -> KnownError:
        from sfm_audit.audit.decision.from_table import RedecisionError  # noqa: PLC0415 - SciPy

        if isinstance(error, RedecisionError):
            return KnownError(f"{self.folder}: {error}", ExitCode.USAGE)
        problem = f"{self.folder}: its tables cannot be decided again ({error!r}); run again"
        return KnownError(problem, ExitCode.UNREADABLE_INPUT)


def _with_counts(models: pa.Table, counts: Mapping[str, int]) -> pa.Table:
    for name, count in counts.items():
        if name in models.column_names:
            at = models.column_names.index(name)
            kind = models.schema.field(at)
            models = models.set_column(at, kind, pa.array([count] * models.num_rows, type=kind.type))
    return models


def _is_torn(findings: Iterable[Mapping[str, Any]] | None) -> bool:
    return any(finding["code"] == FindingCode.PARTS_DISAGREE for finding in findings or ())
