"""Why more than half of a model's images is rejected, or no longer: texts by a person, each with the numbers behind it.

Numbers: `corpus_evidence.summary_numbers`, `evidence` and `refit_numbers`. A text is formatted with them; a claim is a
number and the interval it has to lie in. Model names are those of the corpus.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

Claim = tuple[str, float, float]


@dataclass(frozen=True, slots=True)
class Explanation:
    """A text with places for numbers; claims (number, lowest, highest); camera models to adjust again with."""

    text: str
    claims: tuple[Claim, ...]
    refit: tuple[str, ...] = ()

    def told(self, numbers: Mapping[str, float]) -> str:
        """Return the text with its numbers."""
        return self.text.format_map(numbers)

    def unsupported(self, numbers: Mapping[str, float]) -> list[str]:
        """Return the claims that do not hold, in words."""
        return [
            f"{name} = {numbers.get(name, math.nan):.3g}, not in {low:g} .. {high:g}"
            for name, low, high in self.claims
            if not low <= numbers.get(name, math.nan) <= high
        ]


_ALL = 1e9
_LENS_NOT: Final = (("common_radial_px", 0.0, 0.1), ("common_tangential_px", 0.0, 0.1))

_FOX: Final = Explanation(
    "Portrait video of a phone (the fox scene of instant-ngp), one shared OPENCV camera. The lens is fine: pooled "
    "over all images no group exceeds {common_smooth_px:.2f} px. What is material differs from image to image: joint "
    "smooth {joint_smooth_px:.2f} px, rolling shutter {joint_rolling_shutter_px:.2f} px in the median, worth "
    "{worth_deg:.2f} degrees. A hand that moves while a rolling "
    "shutter reads the rows does that; a constant velocity over the frame explains a part only "
    "({beyond_rs_px:.2f} px of smooth field stay beyond it). {cause_rolling_shutter:.0f} images are named rolling "
    "shutter, {cause_smooth:.0f} smooth. A part of the significance is neighbours that share an error "
    "({by_observations:.0%} of the images by observations, {by_cells:.0%} by cells).",
    (
        ("common_smooth_px", 0.0, 0.1),
        ("smooth_px", 0.2, 0.5),
        ("cause_rolling_shutter", 8, 30),
        ("by_cells", 0.3, 0.7),
        ("rejected_ks", 0, 10),
    ),
)
_YOWSITIAN: Final = (
    "A video of 118 frames (portrait, {track_length:.0f} of 118 images see the median point), cameras adjusted frame "
    "by frame. Not the lens: the field that all frames have in common is {common_smooth_px:.2f} px, a frame's own "
    "smooth field {smooth_px:.2f} px. The cause is named rolling shutter in {cause_rolling_shutter:.0f} frames, "
    "smooth in {cause_smooth:.0f}; linear motion during the frame does not exhaust it ({beyond_rs_px:.2f} px beyond "
    "it). A point's error persists into the next frame (correlation {persistence:.2f}) and is shared with its "
    "neighbours ({neighbours:.2f}), so errors that drift along with the surface are in it too, and the "
    "test, which takes points for independent, finds more than there is ({by_observations:.0%} of the frames by "
    "observations, {by_cells:.0%} by cells)."
)
_YOWSITIAN_CLAIMS: Final = (
    *_LENS_NOT,
    ("common_smooth_px", 0.0, 0.06),
    ("smooth_px", 0.3, 0.7),
    ("persistence", 0.6, 1.0),
    ("neighbours", 0.2, 0.4),
    ("cause_rolling_shutter", 35, 70),
)
_SCEAUX: Final = (
    "Photos of a compact camera, adjusted as {sharing}. That model lacks a term of the lens: radial (r^4 and up) "
    "{radial_px:.2f} px in the median image, {common_radial_px:.2f} px common to all of them. Refitted as OPENCV, "
    "radial is {refit_OPENCV_radial_px:.2f} px and smooth {refit_OPENCV_smooth_px:.2f} px (now {smooth_px:.2f}); then "
    "misfit rejects {refit_OPENCV_rejected_misfit:.0f} (now {rejected_misfit:.0f}), see own_sceaux_castle_opencv. The "
    "name `smooth` for the cause is its BIC: the terms of OPENCV together."
)
_SCEAUX_CLAIMS: Final = (
    ("common_radial_px", 0.08, 0.25),
    ("rejected_misfit", 7, 11),
    ("refit_OPENCV_rejected_misfit", 0, 6),
    ("refit_OPENCV_smooth_px", 0.0, 0.15),
)
_TERTEROS: Final = Explanation(
    "2 of 3 were rejected by KS, at p between 0.01 and 0.03. With three images a track has {track_length:.1f} "
    "observations, {unverifiable:.0%} of the inliers cannot be verified, and the noise of a track is predicted from a "
    "single other degree of freedom: a question of noise, not of the camera. All are accepted.",
    (("rejected_misfit", 0, 0), ("rejected_noise", 0, 0), ("rejected_ks", 1, 2), ("track_length", 2, 3)),
)

EXPLANATIONS: Final[dict[str, Explanation]] = {
    "9002/0": Explanation(
        "Internet photos, a camera each. The images carry smooth fields of {smooth_px:.2f} px that are no lens ("
        "common to all: {common_smooth_px:.2f} px; the cameras differ, so little is expected) and no rolling shutter "
        "({beyond_rs_px:.2f} px beyond it). Residuals of neighbours are correlated ({neighbours:.2f}), and the noise "
        "is two to three times that of the other internet scenes (s0 in the first table): surfaces that the few "
        "images ({track_length:.1f} per track) place wrongly would look like that. We do not know; the photos are not "
        "in the corpus. KS notices nothing ({rejected_ks:.0f} image).",
        (("smooth_px", 0.4, 0.9), ("common_smooth_px", 0.0, 0.35), ("neighbours", 0.2, 0.5), ("rejected_ks", 0, 2)),
    ),
    "9002/1": Explanation(
        "The second component of 9002, with the same signs: own smooth fields of {smooth_px:.2f} px, common to all "
        "{common_smooth_px:.2f} px, neighbours correlated ({neighbours:.2f}). With {num_inliers:.0f} inliers an image "
        "the name of the cause is uncertain (rolling shutter {cause_rolling_shutter:.0f}, smooth {cause_smooth:.0f}, "
        "what a wrong surface looks like).",
        (("smooth_px", 0.3, 0.8), ("common_smooth_px", 0.0, 0.3), ("num_inliers", 50, 200), ("neighbours", 0.1, 0.4)),
    ),
    "9003/1": Explanation(
        "Internet photos, a camera each. The joint test shows smooth fields of {joint_smooth_px:.2f} px in the median "
        "image ({smooth_px:.2f} px as it stands), a little above 0.2 px in {rejected_misfit:.0f}, worth "
        "{worth_deg:.2f} degrees; version 0.1.0 rejected five. Nothing is common to all ({common_smooth_px:.2f} px): "
        "each image lacks a term of its own lens, and the advice is RADIAL or OPENCV.",
        (("joint_smooth_px", 0.15, 0.3), ("rejected_misfit", 5, 7), ("common_smooth_px", 0.0, 0.15)),
    ),
    "cedric_0401": Explanation(
        "Frames of a device (names are time stamps), written by its owner's tool as pinhole cameras without any "
        "distortion. {common_smooth_px:.2f} px of smooth field are common to all frames: a lens that no parameter "
        "describes. Refitted as OPENCV, the median frame goes from {smooth_px:.2f} to {refit_OPENCV_smooth_px:.2f} px "
        "of smooth field and misfit still rejects {refit_OPENCV_rejected_misfit:.0f} of 7, so there is more; the rest "
        "differs from frame to frame (rolling shutter {rolling_shutter_px:.2f} px as it stands). With "
        "{num_values:.0f} values per frame KS sees a distance of {ks_distance:.3f}.",
        (
            ("common_smooth_px", 0.1, 0.3),
            ("smooth_px", 0.25, 0.5),
            ("refit_OPENCV_smooth_px", 0.1, 0.3),
            ("refit_OPENCV_rejected_misfit", 3, 7),
            ("rejected_ks", 6, 7),
        ),
        ("OPENCV",),
    ),
    "gtsfm_astrovision_vesta": Explanation(
        "Not measurements: the 2D points are projections of the 3D points (RMS 0 px), which KS and misfit leave "
        "undetermined. `plausible` rejects the focal length of {focal_over_size:.1f} image widths; for a telescope in "
        "space that is right, and max_focal_over_size is the setting to change.",
        (("sigma_px", 0.0, 1e-9), ("focal_over_size", 10, 12), ("rejected_plausible", 4, 4), ("rejected_ks", 0, 0)),
    ),
    "gtsfm_crane_mast_txt": Explanation(
        "A wide lens (f = {focal_over_size:.2f} image widths) with a single distortion parameter, shared by all "
        "images. The clearest lens of the corpus: {common_smooth_px:.2f} px of the {smooth_px:.2f} px smooth field "
        "are common to all images, {common_radial_px:.2f} px of it radial, {rolling_shutter_px:.2f} px look like "
        "rolling shutter. Refitted as OPENCV: {refit_OPENCV_smooth_px:.2f} px and {refit_OPENCV_rejected_misfit:.0f} "
        "of 8 rejected by misfit; as FULL_OPENCV: {refit_FULL_OPENCV_smooth_px:.2f} px and "
        "{refit_FULL_OPENCV_rejected_misfit:.0f}. The advice, `none: smooth`, is too pessimistic: no model passes the "
        "linearised retest, FULL_OPENCV does after adjustment.",
        (
            ("common_radial_px", 0.3, 0.7),
            ("common_smooth_px", 0.5, 0.8),
            ("refit_OPENCV_smooth_px", 0.1, 0.35),
            ("refit_FULL_OPENCV_rejected_misfit", 0, 1),
        ),
        ("OPENCV", "FULL_OPENCV"),
    ),
    "gtsfm_palace_txt": Explanation(
        "Not a reconstruction as it is stored: ids count from zero, tracks and images disagree, width and height are "
        "swapped (findings). Residuals of {sigma_px:.0f} px, poses that a change would improve by "
        "{pose_offset_px:.0f} px; every image is rejected by its pose, and rightly. No lens is diagnosed "
        "where no pose holds.",
        (("sigma_px", 50, _ALL), ("pose_offset_px", 50, _ALL), ("rejected_pose", 11, 11), ("rejected_misfit", 0, 0)),
    ),
    "hsu_fox_bin": _FOX,
    "hsu_fox_txt": _FOX,
    "marychrisgo_dense": Explanation(
        "Five undistorted photos. Misfit rejects {rejected_misfit:.0f} (version 0.1.0: 2, the others by KS): joint "
        "smooth fields of {joint_smooth_px:.2f} px, of which the points hid a third ({smooth_px:.2f} px as it stands), "
        "worth {worth_deg:.2f} degrees. The fields differ between the images (common: {common_smooth_px:.2f} px): what "
        "an image-wise camera and its undistortion left, not one lens.",
        (("rejected_misfit", 4, 5), ("joint_smooth_px", 0.2, 0.4), ("common_smooth_px", 0.0, 0.1)),
    ),
    "pradyumna_s1": Explanation(
        "Portrait video frames, one shared SIMPLE_RADIAL camera. Two faults. The lens: {common_radial_px:.2f} px "
        "radial common to all frames; the pooled test says the same and advises RADIAL, which is a step only (the "
        "distortion is no short polynomial): refitted as FULL_OPENCV the smooth field falls from {smooth_px:.2f} to "
        "{refit_FULL_OPENCV_smooth_px:.2f} px and misfit rejects {refit_FULL_OPENCV_rejected_misfit:.0f} instead of "
        "{rejected_misfit:.0f}; as OPENCV {refit_OPENCV_rejected_misfit:.0f}. The rest differs from frame to frame "
        "(rolling shutter {rolling_shutter_px:.2f} px as it stands, {refit_FULL_OPENCV_rolling_shutter_px:.2f} px "
        "after the refit): motion during the frame.",
        (
            ("common_radial_px", 0.15, 0.35),
            ("refit_FULL_OPENCV_smooth_px", 0.05, 0.2),
            ("refit_FULL_OPENCV_rejected_misfit", 10, 26),
            ("rejected_misfit", 28, 34),
        ),
        ("OPENCV", "FULL_OPENCV"),
    ),
    "pratikk_sfm_7": Explanation(
        "A fragment of a video whose cameras are no cameras: focal lengths of {focal_over_size:.0f} image widths (15 "
        "to 36), distortion that folds in {folds:.0f} of 14 images, nothing identified. Residuals are fine and misfit "
        "rejects {rejected_misfit:.0f}, for that reason: such a camera fits anything. This is what `plausible` is for.",
        (("focal_over_size", 10, 40), ("rejected_plausible", 14, 14), ("rejected_misfit", 0, 1), ("folds", 10, 14)),
    ),
    "sbcv_sceaux_bin": Explanation(
        _SCEAUX.replace("{sharing}", "one shared SIMPLE_RADIAL camera"), _SCEAUX_CLAIMS, ("OPENCV",)
    ),
    "sbcv_sceaux_percam_txt": Explanation(
        _SCEAUX.replace("{sharing}", "a SIMPLE_RADIAL camera for each photo"), _SCEAUX_CLAIMS, ("OPENCV",)
    ),
    "sbcv_subfolders_txt": Explanation(
        _SCEAUX.replace("{sharing}", "one shared SIMPLE_RADIAL camera, two photos fewer"), _SCEAUX_CLAIMS, ("OPENCV",)
    ),
    "yifr": Explanation(
        "Frames of a small square video, {num_inliers:.0f} inliers in a corner of the median image, a camera for each "
        "frame. Rolling shutter {rolling_shutter_px:.2f} px; the affine group, which is an echo of it, "
        "{affine_px:.2f} px and mostly the name given ({cause_affine:.0f} affine, {cause_rolling_shutter:.0f} rolling "
        "shutter), so the advice OPENCV is misleading here. When rolling shutter is allowed for, the smooth field "
        "({smooth_px:.2f} px) falls to {beyond_rs_px:.2f} px and is significant in {beyond_rs:.0%} of the images; "
        "what all frames have in common is {common_affine_px:.2f} px of affine, so it is not the sensor's pixels. "
        "Errors persist into the next frame ({persistence:.2f}). `plausible` rejects {rejected_plausible:.0f}: with "
        "so few points the distortion is free to fold.",
        (
            ("rolling_shutter_px", 0.6, 1.3),
            ("beyond_rs_px", 0.0, 0.45),
            ("beyond_rs", 0.0, 0.3),
            ("common_affine_px", 0.0, 0.2),
            ("rejected_plausible", 8, 20),
        ),
    ),
    "yinsy_A": Explanation(
        "Video frames, cameras adjusted frame by frame. Not the lens: {common_smooth_px:.2f} px of the "
        "{smooth_px:.2f} px smooth field are common to all frames, {common_radial_px:.2f} px radial. Not a linear "
        "motion during the frame either ({beyond_rs_px:.2f} px beyond rolling shutter). A part is neighbours that "
        "share their error (correlation {neighbours:.2f}; {by_observations:.0%} by observations, {by_cells:.0%} by "
        "cells). What is left, fields that change from frame to frame, is what video stabilisation and compression "
        "make; the files do not tell which.",
        (
            ("common_smooth_px", 0.0, 0.15),
            ("smooth_px", 0.3, 0.6),
            ("neighbours", 0.1, 0.3),
            ("by_cells", 0.5, 0.9),
            ("beyond_rs_px", 0.2, 0.5),
        ),
    ),
    "yoojuno_r1_1": Explanation(
        "Two frames, 24 points, a focal length of {focal_over_size:.3f} image widths (5 px) with residuals of 0.2 px: "
        "no camera. `plausible` rejects both; nothing else can.",
        (("focal_over_size", 0.0, 0.01), ("rejected_plausible", 2, 2), ("rejected_ks", 0, 0)),
    ),
    "yowsitian_dense": Explanation(_YOWSITIAN, _YOWSITIAN_CLAIMS),
    "yowsitian_sparse": Explanation(
        _YOWSITIAN + " Radial in {cause_radial:.0f} frames: k is around 3 there, adjusted by each frame for itself.",
        (*_YOWSITIAN_CLAIMS, ("cause_radial", 15, 40)),
    ),
}

ENDED: Final[dict[str, Explanation]] = {
    "gtsfm_lund_gt_txt": Explanation(
        "All images were rejected by KS alone, at a distance of {ks_distance:.3f} with {num_values:.0f} values "
        "each: the noise is not quite the track model's (excess kurtosis {kurtosis:.2f}, of "
        "{kurtosis_constant:.1f} under constant noise), by less than anybody sees. Joint smooth field "
        "{joint_smooth_px:.2f} px.",
        (("rejected_misfit", 0, 0), ("rejected_noise", 0, 0), ("rejected_ks", 10, 12), ("ks_distance", 0.01, 0.04)),
    ),
    "multicam_robot_bin": Explanation(
        "35 of 42 were rejected by KS for heavy tails that the tracks do not predict (excess kurtosis "
        "{kurtosis:.2f}): a small RGB-D sensor, many keypoints found twice on one spot. `verdict_noise` rejects "
        "{rejected_noise:.0f}. The joint test rejects {rejected_misfit:.0f}; the others carry "
        "{joint_smooth_px:.2f} px of smooth field.",
        (("rejected_misfit", 0, 4), ("rejected_noise", 0, 0), ("rejected_ks", 25, 42), ("joint_smooth_px", 0.0, 0.12)),
    ),
    "own_sceaux_castle_opencv": Explanation(
        "All 11 were rejected by KS, none by misfit. Now `verdict_noise` rejects none. The joint test, which does not "
        "lose to the points what it looks for, shows {joint_smooth_px:.2f} px of smooth field in the median image. It "
        "rejects {rejected_misfit:.0f}; three more exceed 0.2 px by their principal point, which COLMAP never freed, "
        "and are accepted with a remark: it is worth {worth_centre:.2%} of the depth in the median.",
        (("rejected_misfit", 1, 3), ("rejected_noise", 0, 0), ("rejected_ks", 9, 11), ("worth_centre", 0.0, 0.001)),
    ),
    "own_south_building_sub_radial": Explanation(
        "7 of 17 were rejected by KS; now {rejected_noise:.0f}, by `verdict_noise`. No material misfit.",
        (("rejected_misfit", 0, 1), ("rejected_noise", 0, 3), ("rejected_ks", 4, 10)),
    ),
    "terteros_bin": _TERTEROS,
    "terteros_txt": _TERTEROS,
}
"""Models of which version 0.1.0 rejected images by KS alone."""
