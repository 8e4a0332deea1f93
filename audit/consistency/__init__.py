"""Whether cameras, poses, points and 2D points belong together (method.md section 12). Asked before any lens.

A lens, a rolling shutter or a noise model can only be diagnosed where residuals are small against the image: a model
whose 2D points are at half the size of its cameras has residuals of hundreds of pixels that every field of every lens
explains a little. So the first question is whether the four parts are parts of one model.

Per image (`image_consistency`): the share of the points in front of the camera; the RMS residual after one step of the
image's own pose (a pose that somebody moved is `pose_not_optimal`, and no other part is to blame); the robust affine
map observed = A projected + b of the model as it stands. An image is *inconsistent* if

- its RMS exceeds 1 % of the width after the pose's step, or 20 px and 20 times what the affine map leaves, and more
  than a few wrong links make it so; or
- more than 20 % of its observations lie behind the camera (there they have no valid projection).

Such an image has no misfit group and no advice and is left out of everything that is shared. An image that exceeds a
limit before its pose's step alone is ``moved``.

Per model (`model_consistency`): `parts_disagree` where half of the images that can be judged are inconsistent or moved,
or more than 20 % of all observations lie behind; `points_behind` where all do; `images_disagree` for fewer, with names;
`pixel_convention`, which rejects nothing.

The cause is read off the affine map where that leaves little, else other readings of pose and points are tried:

==========================  ==========================================================================================
cause                       what is seen (s a factor, pp the principal point, w and h the size)
==========================  ==========================================================================================
resolution                  A = s 1, b = 0: 2D points or cameras of another resolution
focal_length                A = s 1 with s within 1.5 of 1, b = (1 - s) pp: stored focal length / right one = 1 / s
principal_point_zero        A = 1, b = about (w, h) / 2, pp = about 0
shift                       A = 1, another b: a crop, or another principal point
mirrored                    A with a negative entry (y_observed = h - y_projected), or x and y exchanged
turned                      A with both entries negative, or exchanged and one negative: 180, 90, 270 degrees
camera_axes                 y and z of the points negated, they are in front and fit (OpenGL, Blender)
inverted_poses              poses taken as world_from_cam, the points fit
quaternion_order            quaternions taken as x, y, z, w, the points fit
point_scale                 points and poses have different scales: one factor on the points, and they fit
links                       most 2D points fit and over 20 % are far off: linked to points that they do not show
poses                       one step of the pose brings the residuals home (``moved``)
poses_or_points             none of these
==========================  ==========================================================================================

A half pixel (`pixel_convention`): A = 1 and a shift of +-(0.5, 0.5) px within 5 sd in over half of the images, before
the pose's step, which would hide it. It can be seen only where nobody adjusted the poses since.

Rounded poses (`rounded_decimals`): all stored quaternions and translations have a few decimals only. Nothing is
rejected for it; the pose's own step says what it cost.

Blind spots: whatever was adjusted together after the fault. An affine map of a flat or distant scene is also what a
turned or shifted camera does, and then the pose's step takes it. Panoramas have no affine map. Fewer than 20
observations say nothing.
"""

from __future__ import annotations

from sfm_audit.audit.consistency.affine import AffineFit, fit_affine
from sfm_audit.audit.consistency.cause import CAUSE_MEANINGS, Cause, Explanation
from sfm_audit.audit.consistency.image import ConsistencyLimits, ImageConsistency, image_consistency
from sfm_audit.audit.consistency.model import (
    ConsistencyCode,
    ConsistencyFinding,
    ModelConsistency,
    consistency_of,
    model_consistency,
)
from sfm_audit.audit.consistency.rounding import rounded_decimals

__all__ = [
    "CAUSE_MEANINGS",
    "AffineFit",
    "Cause",
    "ConsistencyCode",
    "ConsistencyFinding",
    "ConsistencyLimits",
    "Explanation",
    "ImageConsistency",
    "ModelConsistency",
    "consistency_of",
    "fit_affine",
    "image_consistency",
    "model_consistency",
    "rounded_decimals",
]
