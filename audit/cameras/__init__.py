"""Where a camera sees a point, and how that moves with the point and with the camera's parameters.

All 18 of COLMAP's models, on whole arrays. ``projection`` and ``unprojection`` are the interface, ``models`` is the
list of models, one record each (``functions``). ``warps`` holds the distortions of a plane, ``rational`` the models
that distort the ray itself, ``fisheye`` the equidistant map before a distortion, ``spherical`` the panorama,
``inverse`` the way back from the distorted plane to rays.
"""

from __future__ import annotations

from sfm_audit.audit.cameras.projection import (
    Projection,
    distorted_normalised,
    is_fisheye,
    normalised,
    project,
    project_columns,
    project_with_jacobians,
)
from sfm_audit.audit.cameras.unprojection import unproject

__all__ = [
    "Projection",
    "distorted_normalised",
    "is_fisheye",
    "normalised",
    "project",
    "project_columns",
    "project_with_jacobians",
    "unproject",
]
