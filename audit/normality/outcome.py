"""What a test says: its statistic and its p-value."""

from __future__ import annotations

import math
from typing import NamedTuple


class Outcome(NamedTuple):
    """Statistic (see each test) and p-value in [0, 1]; both NaN where the test could not run."""

    statistic: float
    p: float


NOT_RUN = Outcome(math.nan, math.nan)
