"""Who can be asked about an image besides itself, and what may such a witness decide? (method.md section 13).

A witness rejects only where its false alarms were counted on real healthy images, and are rare beyond doubt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from sfm_audit.loaders.model import FindingCode

MAX_FALSE_ALARMS: Final = 0.01
"""Upper end of Wilson's 95 % interval of its share of false alarms on healthy images of real photos, before it may
reject: at least 381 images."""
_Z: Final = 1.959963984540054  # 97.5 % point of the normal law


class Witness(StrEnum):
    """The witnesses outside of the image, as the column ``witnesses`` names them."""

    PAIRS = "pairs"
    FOLD = "fold"
    REFERENCE = "reference"
    PRIORS = "priors"


@dataclass(frozen=True, slots=True)
class WitnessWords:
    """What a witness is asked, and what it may decide.

    question: of each image.    needs: what it has to be given.    num_false_alarms, num_healthy: healthy images of real
    photos that it spoke against, and that it was asked about (docs/witnesses.md).    findings: of the model.
    """

    question: str
    needs: str
    num_false_alarms: int = 0
    num_healthy: int = 0
    findings: tuple[FindingCode, ...] = ()

    @property
    def may_reject(self) -> bool:
        """Whether it was measured on enough healthy images, and is rarely wrong about them."""
        return wilson_upper(self.num_false_alarms, self.num_healthy) < MAX_FALSE_ALARMS


def wilson_upper(num: int, total: int) -> float:
    """Return the upper end of Wilson's 95 % interval of a share; 1 without any."""
    if not total:
        return 1.0
    share, z2 = num / total, _Z**2
    middle = share + z2 / (2 * total)
    return (middle + _Z * math.sqrt(share * (1 - share) / total + z2 / (4 * total**2))) / (1 + z2 / total)


WITNESSES: Final[dict[Witness, WitnessWords]] = {
    Witness.PAIRS: WitnessWords(
        "do the verified matches with its covisible neighbours agree with their cameras?",
        "the database.db of the model (--database)",
        num_false_alarms=0,
        num_healthy=563,  # scripts/study_pairs.py
        findings=(FindingCode.CONTRADICTED_PAIRS, FindingCode.DATABASE_NOT_USED),
    ),
    Witness.FOLD: WitnessWords(
        "is a point seen by all images that should see it?",
        "nothing but the model",
        findings=(FindingCode.POSSIBLE_FOLD,),
    ),
    Witness.REFERENCE: WitnessWords(
        "is the pose where a reference has it?",
        "poses of a reference (--reference)",
        num_false_alarms=1,
        num_healthy=196,  # scripts/study_references.py
        findings=(
            *(FindingCode.REFERENCE_NOT_USED, FindingCode.REFERENCE_FRAGMENTS),
            *(FindingCode.REFERENCE_DRIFT, FindingCode.REFERENCE_SCALE),
        ),
    ),
    Witness.PRIORS: WitnessWords(
        "is the centre where its prior has it?",
        "position priors (--priors)",
        findings=(
            *(FindingCode.PRIORS_NOT_USED, FindingCode.PRIORS_DRIFT),
            *(FindingCode.PRIORS_SPREAD, FindingCode.PRIORS_SCALE),
        ),
    ),
}
"""The one list of witnesses, with what was measured of each."""


@dataclass(frozen=True, slots=True)
class WitnessStatement:
    """What one witness says of one image.

    score: what was measured, in ``unit``; the witness disagrees where it is above ``limit``, and, where a q-value is
    given, only if that is below alpha.    text: the same in words, as tables show it after the code.
    A witness that can say nothing of an image gives no testimony of it.
    """

    witness: Witness
    score: float
    limit: float
    text: str
    q: float = math.nan
    unit: str = "1"
