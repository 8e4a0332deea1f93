"""What one question makes of many images: a verdict for each, and the reasons, said of some of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from sfm_audit.audit.table.words import VERDICT_ORDER, Member, MisfitGroup, Reason, ReasonCode, Verdict
from sfm_audit.loaders.arrays import BoolArray, FloatArray, IntArray

VERDICTS: Final = tuple(sorted(Verdict, key=VERDICT_ORDER.__getitem__))
"""A verdict in a column is its place in here: the smaller one wins."""
NOT_ASKED: Final = len(VERDICTS)

Numbers = npt.NDArray[Any] | float | None


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict with the reasons for it; an accepted image may carry remarks that decide nothing."""

    verdict: Verdict
    reasons: tuple[Reason, ...] = ()


def undetermined(*reasons: Reason) -> Judgement:
    """Return that nothing can be said, and why."""
    return Judgement(Verdict.UNDETERMINED, reasons)


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """One reason, of those images that it holds for: `Reason` as columns.

    rows: (k,) ascending.    texts: k.    value, limit: (k,), NaN where there is none.
    """

    code: ReasonCode
    member: Member
    unit: str
    group: MisfitGroup | None
    rows: IntArray
    texts: Sequence[str]
    value: FloatArray
    limit: FloatArray

    def only(self, kept: BoolArray) -> Said:
        """Return it of those images alone that are kept (n,)."""
        mask = kept[self.rows]
        texts = [text for text, holds in zip(self.texts, mask.tolist(), strict=True) if holds]
        return Said(
            *(self.code, self.member, self.unit, self.group),
            self.rows[mask],
            texts,
            self.value[mask],
            self.limit[mask],
        )

    def reason(self, k: int) -> Reason:
        """Return the k-th of them."""
        return Reason(
            *(self.code, self.member, self.texts[k], _or_none(self.value[k]), _or_none(self.limit[k])),
            self.unit,
            self.group,
        )


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else float(value)


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """What one question says of n images: (n,) places in VERDICTS or NOT_ASKED, and reasons in the order of one image.

    An image for which nobody asked has no reasons.
    """

    verdict: IntArray
    said: tuple[Said, ...]

    @classmethod
    def of(cls, cases: Mapping[Verdict, BoolArray], otherwise: Verdict, said: Sequence[Said]) -> Judged:
        """Return the verdict of the first case that holds."""
        verdict: IntArray = np.full(len(next(iter(cases.values()))), VERDICT_ORDER[otherwise])
        for made, holds in reversed(list(cases.items())):
            verdict[holds] = VERDICT_ORDER[made]
        return cls(verdict, tuple(each for each in said if each.rows.size))

    def of_those(self, asked: BoolArray) -> Judged:
        """Return it for those alone who are asked (n,)."""
        if asked.all():
            return self
        said = (each.only(asked) for each in self.said)
        return Judged(np.where(asked, self.verdict, NOT_ASKED), tuple(each for each in said if each.rows.size))


@dataclass(frozen=True, slots=True)
class About:
    """What a reason is about, and what its numbers are: see `Reason`."""

    code: ReasonCode
    member: Member
    unit: str = ""
    group: MisfitGroup | None = None


def say(
    holds: BoolArray,
    about: About,
    text: Callable[[int], str],
    value: Numbers = None,
    limit: Numbers = None,
    *,
    depends_on: Sequence[npt.NDArray[Any]] | None = None,
) -> Said:
    """Say something of those images for which it holds (n,).

    Parameters
    ----------
    text : of the image in a row        value, limit : (n,), or one for all, or none
    depends_on : (n,) each, all that the text depends on, where many images may have the same; put into words once
    """
    rows = np.flatnonzero(holds)
    texts: list[str]
    if depends_on is None:
        texts = [text(row) for row in rows.tolist()]
    else:
        known: dict[Hashable, str] = {}
        texts = []
        for row, key in zip(
            rows.tolist(), zip(*(each[rows].tolist() for each in depends_on), strict=True), strict=True
        ):
            if key not in known:
                known[key] = text(row)
            texts.append(known[key])
    return Said(*(about.code, about.member, about.unit, about.group), rows, texts, _at(value, rows), _at(limit, rows))


def _at(numbers: Numbers, rows: IntArray) -> FloatArray:
    if isinstance(numbers, np.ndarray):
        return numbers[rows].astype(np.float64)
    return np.full(rows.size, math.nan if numbers is None else float(numbers))


def said_of(reasons: Mapping[int, Sequence[Reason]], member: Member) -> Iterator[Said]:
    """Yield reasons that are at hand, by row, as ones of this member; those of one image in their order."""
    for k in range(max(map(len, reasons.values()), default=0)):
        alike: dict[About, list[int]] = {}
        for row, each in sorted(reasons.items()):
            if k < len(each):
                alike.setdefault(About(each[k].code, member, each[k].unit, each[k].group), []).append(row)
        for about, rows in alike.items():
            own = [reasons[row][k] for row in rows]
            numbers = [(math.nan if x is None else x for x in (each.value, each.limit)) for each in own]
            value, limit = np.array([tuple(pair) for pair in numbers], dtype=np.float64).reshape(-1, 2).T
            texts = [each.text for each in own]
            yield Said(about.code, member, about.unit, about.group, np.array(rows), texts, value, limit)
