"""The one list of the witnesses that are asked, and what they say together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.witnesses.connectivity import ask_connectivity
from sfm_audit.audit.witnesses.evidence import Evidence, WitnessReport
from sfm_audit.audit.witnesses.fold import ask_fold
from sfm_audit.audit.witnesses.pairs import ask_pairs
from sfm_audit.audit.witnesses.priors import ask_priors
from sfm_audit.audit.witnesses.reference import ask_reference
from sfm_audit.audit.witnesses.rigs import ask_rigs
from sfm_audit.loaders.model import Finding

AskedFunction = Callable[[Evidence], WitnessReport | None]
"""Returns None where the evidence that it needs was not given."""

ASKED: Final[tuple[AskedFunction, ...]] = (
    ask_pairs,
    ask_connectivity,
    ask_fold,
    ask_rigs,
    ask_reference,
    ask_priors,
)
"""All that are asked, in the order in which their findings are listed."""


@dataclass(frozen=True, slots=True, eq=False)
class Outside:
    """What was said outside of the images of one model."""

    reports: tuple[WitnessReport, ...]

    @property
    def witnesses(self) -> tuple[Witness, ...]:
        """The witnesses that were asked."""
        return tuple(report.witness for report in self.reports if report.witness is not None)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Their findings about the model."""
        return tuple(finding for report in self.reports for finding in report.findings)

    def testimonies(self, image_idx: int) -> tuple[WitnessStatement, ...] | None:
        """Return what was said of the image in this row; None where no witness was asked."""
        if not self.witnesses:
            return None
        said = (report.testimonies[image_idx] for report in self.reports if report.witness is not None)
        return tuple(each for each in said if each is not None)

    def columns(self, image_idx: int) -> dict[str, object]:
        """Return the columns of the image in this row."""
        return {name: values[image_idx] for report in self.reports for name, values in report.columns.items()}


def ask(evidence: Evidence) -> Outside:
    """Ask everybody on the list."""
    return Outside(tuple(report for asked in ASKED if (report := asked(evidence)) is not None))
