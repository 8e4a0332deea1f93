"""What must hold on the models with ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from scripts.realtruth.bench import healthy, neighbours, rejected
from scripts.realtruth.rates import (
    Rate,
    detections,
    focal_statements,
    implied_principal_points,
    rate,
)


@dataclass(frozen=True, slots=True)
class Bound:
    """A rate that must stay on one side of a limit; nothing to count holds."""

    words: str
    rate: Rate
    limit: float
    at_least: bool = False

    @property
    def holds(self) -> bool:
        """Whether it does."""
        if not self.rate.of:
            return True
        return self.rate.share >= self.limit if self.at_least else self.rate.share <= self.limit

    def __str__(self) -> str:
        side = "at least" if self.at_least else "at most"
        return f"{self.words}: {self.rate}, {side} {self.limit:.1%}"


def bounds(images: pd.DataFrame) -> list[Bound]:
    """Return the rates that must hold."""
    focal = focal_statements(images)
    absorbed, wrong = implied_principal_points(images)
    models = healthy(images).model.nunique()
    return [
        Bound("healthy, rejected by verdict_misfit", rate(rejected(healthy(images), "verdict_misfit")), 0.005),
        Bound("neighbours, rejected by verdict_misfit", rate(rejected(neighbours(images), "verdict_misfit")), 0.03),
        Bound("healthy, rejected by standard", rate(rejected(healthy(images), "under_standard")), 0.02),
        Bound("planted, 0.5 px and more, found", detections(images)["all"]["0.5 px and more"], 0.95, at_least=True),
        Bound("cause named right", detections(images)["all"]["cause right"], 0.90, at_least=True),
        Bound("focal length wrong by over 1 %, accepted, without kitti2", focal["the same without kitti2"], 0.20),
        Bound(
            "healthy, f within 0.5 %, accepted, without temple", focal["the same without temple"], 0.85, at_least=True
        ),
        Bound(
            "absorbed principal point, finding implied_principal_point",
            Rate(sum(absorbed.values()), len(absorbed)),
            1.0,
            at_least=True,
        ),
        Bound("healthy models with implied_principal_point", Rate(len(wrong), models), 0.0),
    ]
