"""What to do about a reason code: usual causes, what to do, what not to conclude. One record per code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sfm_audit.audit.table.words import ReasonCode


@dataclass(frozen=True, slots=True)
class Guidance:
    """For people. causes: the usual ones, most frequent first.    action: to take.    caution: what not to conclude."""

    causes: str
    action: str
    caution: str


REASON_GUIDANCE: Final[dict[ReasonCode, Guidance]] = {
    ReasonCode.KS_REJECTED: Guidance(
        "Noise that differs from keypoint to keypoint or has heavy tails, and thousands of observations, which "
        "make any difference significant; a moved pose.",
        "Read `ks_stat`: below 0.03 beyond 1.36 / sqrt(N) it cannot be seen. Decide by the policy standard or camera.",
        "That the lens is wrong. On real photos KS does not tell wrong lenses from right ones (docs/realtruth.md).",
    ),
    ReasonCode.TOO_FEW_OBSERVATIONS: Guidance(
        "Few matches, tracks that were filtered away, an image at the edge of the collection.",
        "Match the image against more neighbours and triangulate again, or leave it out.",
        "That the image is wrong: it says too little about itself. Nor that it is right.",
    ),
    ReasonCode.NON_FINITE_POSE: Guidance(
        "An optimisation that diverged, or a writer that stored images it never placed.",
        "Remove the image from the model and register it again.",
        "Anything about its camera or its points: nothing of it was looked at.",
    ),
    ReasonCode.NON_FINITE_CAMERA: Guidance(
        "An optimisation that diverged; a division by zero in a converter.",
        "Set the camera to its initial guess (COLMAP: 1.2 times the longer side) and adjust again.",
        "Anything about the poses of its images: they were not looked at.",
    ),
    ReasonCode.MISSING_CAMERA: Guidance(
        "A model that was put together or pruned by hand; camera ids that were renumbered in one file only.",
        "Write cameras, images and points from one reconstruction again.",
        "That the image is wrong. Its camera is not there to be asked.",
    ),
    ReasonCode.EXTREME_VALUES: Guidance(
        "An optimisation that diverged; units mixed up by a converter; a focal length stored as 0.",
        "Repair the number or remove the image, then adjust again.",
        "Anything about the other questions: nothing can be calculated with such a number.",
    ),
    ReasonCode.EXACT_PROJECTIONS: Guidance(
        "A rendered data set, or a converter that projected the points instead of keeping the keypoints.",
        "Audit the model that holds the detected keypoints.",
        "That the cameras are perfect. Residuals of zero were written, not measured.",
    ),
    ReasonCode.NOISE_NOT_FITTED: Guidance(
        "Too few observations that their own tracks can verify; residuals that are all the same.",
        "Give the image longer tracks (more matches), or run with --noise constant.",
        "That the noise is odd. It could not be looked at.",
    ),
    ReasonCode.NON_FINITE_DERIVATIVES: Guidance(
        "Points at the limit of the projection: nearly behind the camera, or where the distortion folds.",
        "Remove such points (COLMAP's filter by triangulation angle and error) and adjust again.",
        "That all of the image is unusable: the other questions may have been answered.",
    ),
    ReasonCode.MISFIT_RADIAL: Guidance(
        "A wide or cheap lens under SIMPLE_RADIAL; distortion parameters shared by different zooms; photos that "
        "were undistorted with another camera.",
        "Refit with one more radial term: SIMPLE_RADIAL to RADIAL, RADIAL to FULL_OPENCV (`sfm-audit diagnose` "
        "tries it).",
        "That the pose is wrong by as much: `misfit_worth_deg` and `misfit_worth_focal_rel` say how much it moves.",
    ),
    ReasonCode.MISFIT_TANGENTIAL: Guidance(
        "A decentred lens; a principal point that nobody freed, which looks nearly the same; cropped photos.",
        "Free the principal point first; if the finding stays, refit as OPENCV.",
        "That it is the lens and not the principal point: the two are one answer to this test.",
    ),
    ReasonCode.MISFIT_AFFINE: Guidance(
        "Photos scaled by different factors in x and y; video with pixels that are not square; rolling shutter, "
        "which looks similar; an old scan.",
        "Refit with fx and fy (PINHOLE, OPENCV). If the refit removes little, suspect rolling shutter.",
        "That the sensor has odd pixels: rolling shutter is significant here too in all simulated cases.",
    ),
    ReasonCode.MISFIT_PRINCIPAL_POINT: Guidance(
        "Cropped photos; a principal point at the image centre that COLMAP did not refine (its default).",
        "Adjust with the principal point free (COLMAP: --BundleAdjustment.refine_principal_point 1), on enough images.",
        "That one image alone knows its principal point well: look at the camera's pooled test first.",
    ),
    ReasonCode.MISFIT_ROLLING_SHUTTER: Guidance(
        "A phone or an action camera that moved while its rows were read; 3D points on a surface that is placed "
        "wrongly.",
        "Take still photos or slower video, or a solver with a rolling-shutter model. No camera model of COLMAP "
        "holds it.",
        "That the shutter is at fault if the camera has a global one: errors shared by neighbouring points give "
        "such a field too.",
    ),
    ReasonCode.MISFIT_SMOOTH: Guidance(
        "Surfaces whose points are placed wrongly together; an unusual lens; motion that is not linear; a "
        "panorama or an edited photo; a fisheye under a perspective model.",
        "Run `sfm-audit diagnose`: common to all images of a camera means lens (try a larger model, then a fisheye), "
        "different from image to image means motion or points.",
        "That a larger camera model would hold it. No named lens error explains this field better.",
    ),
    ReasonCode.SHARED_CAMERA: Guidance(
        "A camera model without the term that the lens needs; photos of several cameras or zooms under one camera id.",
        "Refit the camera with the advised model; split the id where EXIF says that photos differ.",
        "That each of its images is at fault: the camera is, and one repair serves all.",
    ),
    ReasonCode.MISFIT_NOT_TESTED: Guidance(
        "Too few observations for the number of fields; a camera model that has the term already; a pose or a "
        "camera that is wrong otherwise.",
        "Repair what stands in front (pose, camera), or give the image more observations.",
        "That these kinds of misfit are absent.",
    ),
    ReasonCode.POSE_NOT_OPTIMAL: Guidance(
        "Poses changed after the last adjustment (aligned, rounded, replaced by a GPS track); a filter after the "
        "last adjustment; wrong intrinsics with which nobody adjusted again.",
        "Run bundle adjustment once over the whole model and audit again.",
        "That the pose was measured wrongly: it only is not where its own points want it.",
    ),
    ReasonCode.FOCAL_OUT_OF_RANGE: Guidance(
        "A degenerate start (pure rotation, a plane), a panorama or a crop, a focal length in mm taken for px.",
        "Fix the focal length from EXIF or a calibration, and reconstruct again.",
        "That small residuals vouch for it: they are as small with a focal length of 5 px.",
    ),
    ReasonCode.DISTORTION_FOLDS: Guidance(
        "A distortion fitted to points in the middle and extrapolated to the corners; a focal length that ran away.",
        "Refit with fewer distortion parameters or with the focal length fixed.",
        "That the middle of the image is wrong too: the fold may lie where there are no points.",
    ),
    ReasonCode.PRINCIPAL_POINT_OUTSIDE: Guidance(
        "An adjustment with the principal point free on too few images; a crop whose offset was lost.",
        "Fix the principal point at the centre, or restore the offset of the crop.",
        "That the pose is off by as many pixels: rotation takes most of it up.",
    ),
    ReasonCode.FOCAL_NOT_IDENTIFIED: Guidance(
        "Forward motion, distant or flat scenes, one camera per photo with few points each; internet photos.",
        "Share one camera among photos of the same device and zoom, or fix the focal length from EXIF or a "
        "calibration.",
        "That the focal length is wrong. The points only do not say what it is, to within 5 times the sd named.",
    ),
    ReasonCode.K1_NOT_IDENTIFIED: Guidance(
        "A lens without distortion, photos that were undistorted, points in the middle of the image only.",
        "Nothing, or use the smaller camera model if it is advised.",
        "Anything about the verdict: a remark decides nothing.",
    ),
    ReasonCode.LOW_COVERAGE: Guidance(
        "An object in the middle, a repeated texture in one corner, an image at the edge of the collection.",
        "Use the pose for what it is good for, and trust nothing outside the hull of its points.",
        "That the camera is right at the corners, or wrong: no point is there to say so.",
    ),
    ReasonCode.FEW_OCCUPIED_CELLS: Guidance(
        "Few points, or points in clusters.",
        "As for low_coverage.",
        "That the camera is wrong: it is looked at in too few places.",
    ),
    ReasonCode.FRONTO_PARALLEL: Guidance(
        "A calibration board held parallel to the sensor.",
        "Tilt the board by 20 degrees and more in some of the views.",
        "That the focal length is known: distance and focal length are exchangeable here.",
    ),
    ReasonCode.INCONSISTENT: Guidance(
        "Another resolution of the photos than of the cameras, a quaternion in another order, poses of "
        "world-from-camera instead of camera-from-world, images shifted against their poses by one, y or z axes "
        "flipped.",
        "Repair the converter. The cause is named where it can be read from the affine fit (a scale of 0.5: half "
        "size).",
        "Anything about lens or noise: no lens is diagnosed before the parts belong together.",
    ),
    ReasonCode.POINTS_BEHIND: Guidance(
        "Axes flipped (OpenGL or Blender against COLMAP), or poses stored as world-from-camera.",
        "Turn y and z of the cameras round, or invert the poses, and audit again.",
        "Anything else about the model.",
    ),
    ReasonCode.CAMERA_NOT_OPTIMAL: Guidance(
        "Parameters that were fixed in the adjustment: a focal length from EXIF, distortion at zero, intrinsics "
        "of another camera or resolution.",
        "Run bundle adjustment with the named parameter free; the implied value is in the reason.",
        "That the stored value is a bad calibration: it is another one than these points ask for.",
    ),
    ReasonCode.CAMERA_NOT_TESTED: Guidance(
        "Too few inliers, a noise that could not be fitted, derivatives that are odd.",
        "Repair what stands in front, or give the image more observations.",
        "That its parameters are right.",
    ),
    ReasonCode.MISFIT_WITHOUT_WORTH: Guidance(
        "A small principal-point or tangential shift that a rotation takes up.",
        "Nothing for poses. For measuring in the image, refit with the term named.",
        "Anything about the verdict: a remark decides nothing.",
    ),
    ReasonCode.NOISE_DIFFERS: Guidance(
        "Matches of mixed quality, tracks that mix two scene points, a moved pose, motion blur in one direction.",
        "Look at the residuals (`sfm-audit explain`); filter long tracks with large errors and adjust again.",
        "That the camera is wrong: the misfit test speaks for the camera.",
    ),
    ReasonCode.PIXEL_CONVENTION: Guidance(
        "Keypoints whose first pixel centre is (0, 0) beside cameras whose first pixel centre is (0.5, 0.5), as "
        "COLMAP's.",
        "Add 0.5 to the keypoints when they are imported.",
        "That the poses are wrong by more: half a pixel is 0.02 to 0.03 degrees at usual focal lengths.",
    ),
    ReasonCode.DEGENERATE_INPUT: Guidance(
        "Points on a plane, a line or a few places; two views of the same; fewer correspondences than parameters.",
        "Take correspondences from several depths and all over the image.",
        "That the estimator failed: no estimator could do it.",
    ),
    ReasonCode.PAIRS_DISAGREE: Guidance(
        "A wrong place in the model: a repeated facade matched to the wrong copy, a part glued on by few matches.",
        "Look at the pairs named; reconstruct without the matches that only one side supports.",
        "That one contradicting pair suffices: right models of symmetric buildings contradict 40 to 52 % of their "
        "pairs.",
    ),
    ReasonCode.FOLD_DISAGREES: Guidance(
        "Two sides of a symmetric object laid on top of each other.",
        "Look at both groups of images; match them again with wider baselines or without the ambiguous ones.",
        "That a model without this reason has no fold: the score was measured on few folds.",
    ),
    ReasonCode.REFERENCE_DISAGREES: Guidance(
        "A pose that is wrong, a reference of another frame, time or scale, an alignment that one outlier pulled.",
        "Compare the neighbours: if all are off by the same, the alignment is; if one is, its pose. Who trusts the "
        "reference leaves such images out with `sfm-audit filter RUN --reason reference_disagrees --list kept.txt`.",
        "That the reference is the truth.",
    ),
    ReasonCode.PRIORS_DISAGREE: Guidance(
        "A GPS reading under trees or between walls, a wrong lever arm, a pose that is wrong.",
        "Look at the sd that the prior claims first, then at the images around. Who trusts the priors leaves such "
        "images out with `sfm-audit filter RUN --reason priors_disagree --list kept.txt`.",
        "That the prior is the truth.",
    ),
}
