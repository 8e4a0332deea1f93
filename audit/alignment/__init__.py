"""How do two sets of poses of the same images lie to each other? A robust similarity, and who does not follow it.

`align` finds the similarity that takes the first set to the second for as many images as possible; `compare_poses`
says of every image how far it is off after that, which images moved together as a fragment, and how much the whole is
bent. Which of two sets is right, poses do not say: the larger group is called the main one, no more.

Lengths are in units that the caller chooses, usually the median depth of the points before the cameras: an error of
0.01 is then one of 0.01 rad in what the cameras see.
"""

from __future__ import annotations

from sfm_audit.audit.alignment.motion import Fragment, PoseComparison, compare_poses
from sfm_audit.audit.alignment.poses import Poses, natural_order, usable_poses
from sfm_audit.audit.alignment.similarity import Alignment, Similarity, align

__all__ = [
    "Alignment",
    "Fragment",
    "PoseComparison",
    "Poses",
    "Similarity",
    "align",
    "compare_poses",
    "natural_order",
    "usable_poses",
]
