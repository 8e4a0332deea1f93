"""What do the tables say of how well poses are known? Columns that are null without ``run --covariance``."""

from __future__ import annotations

import math
from typing import Final

from sfm_audit.audit.table.kinds import Column, text
from sfm_audit.audit.table.types import DOUBLE, list_of

GAUGE: Final = (
    "errors left after the similarity that fits the poses of its connected part best, rotations in rad and centres in "
    "median depths weighed alike"
)
"""In the metadata of each column that depends on it."""
_REAL: Final = "joint system; real errors are 3 to 4 x as large"

POSE: Final = (
    Column(
        "sd_rotation_deg",
        DOUBLE,
        "deg",
        f"root of the expected squared angle of the rotation's error; {_REAL}; null without --covariance",
        GAUGE,
    ),
    Column("sd_centre", DOUBLE, "1", f"the same of the camera's centre, median depths; {_REAL}", GAUGE),
    Column(
        "pose_sds",
        list_of(DOUBLE),
        "deg and 1",
        "sd of the rotation about the camera's x, y, z, degrees, and of its centre along them, median depths",
        GAUGE,
    ),
    Column(
        "pose_correlations",
        list_of(DOUBLE),
        "1",
        "correlations of the six of pose_sds and the camera's own_parameters, below the diagonal, row by row",
        GAUGE,
    ),
    text("sd_neighbour", "image of another frame that shares most points with it"),
    Column("sd_rotation_rel_deg", DOUBLE, "deg", "as sd_rotation_deg, of the rotation against sd_neighbour: no gauge"),
    Column(
        "sd_centre_rel",
        DOUBLE,
        "1",
        "as sd_centre, of the centre of sd_neighbour as the image sees it",
        "the scale is that of the whole, as for sd_centre; nothing else of the gauge matters",
    ),
)
POSE_COLUMNS: Final = {column.name: math.nan if column.kind == DOUBLE else None for column in POSE}
"""The columns, and what stands there where nobody asked."""
