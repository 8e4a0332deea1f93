"""What to do about a finding of a model: usual causes, what to do, what not to conclude. One record per code."""

from __future__ import annotations

from typing import Final

from sfm_audit.audit.table.guidance_reasons import Guidance
from sfm_audit.loaders.model import FindingCode

FINDING_GUIDANCE: Final[dict[FindingCode, Guidance]] = {
    FindingCode.BINARY_TEXT_DISAGREE: Guidance(
        "A model that was exported as text and changed afterwards, in one of the two.",
        "Delete the files that are out of date; audit the others.",
        "That the text files were audited: binary ones come first, as in COLMAP.",
    ),
    FindingCode.TRACKS_DISAGREE: Guidance(
        "A model that was pruned or merged by a script that wrote one of the two files only.",
        "Load and write the model with COLMAP or pycolmap, or make the files again.",
        "That tracks were used: the images' own point ids were.",
    ),
    FindingCode.DANGLING_POINT_IDS: Guidance(
        "Points that were deleted from points3D alone.",
        "Write the model again from one program; the observations are lost until then.",
        "That these observations are wrong: they were not looked at.",
    ),
    FindingCode.UNSEEN_POINTS: Guidance(
        "A dense or imported cloud stored as points3D; images that were removed.",
        "Nothing for the audit. Remove them to save time.",
        "Anything about the cameras.",
    ),
    FindingCode.SHORT_TRACKS: Guidance(
        "Points of which all observations but one were removed.",
        "Remove these points: a single observation says nothing.",
        "Anything about the cameras: such points verify nobody.",
    ),
    FindingCode.REPEATED_OBSERVATIONS: Guidance(
        "Two keypoints on one spot (SIFT gives several orientations), a track that was merged; usual in small numbers.",
        "Nothing, unless they are a large share.",
        "That the model is broken: most real models have some.",
    ),
    FindingCode.STORED_ERRORS_ZERO: Guidance(
        "A writer that leaves the field empty.",
        "Do not filter by stored errors; use the recomputed ones.",
        "That the residuals are zero.",
    ),
    FindingCode.STORED_ERRORS_MISSING: Guidance(
        "Points that were added after the last adjustment.",
        "Do not filter by stored errors; use the recomputed ones.",
        "That these points are bad.",
    ),
    FindingCode.STORED_ERRORS_STALE: Guidance(
        "Cameras, poses or points changed after the errors were written; another definition of the error.",
        "Do not filter by stored errors; use the recomputed ones.",
        "That the model is worse than it says: the direction is in the two means.",
    ),
    FindingCode.ORPHAN_CAMERAS: Guidance(
        "A database with more photos than were registered.",
        "Nothing.",
        "That registered images lack a camera.",
    ),
    FindingCode.MISSING_CAMERAS: Guidance(
        "A model put together or pruned by hand.",
        "Write cameras and images from one reconstruction again.",
        "That these images are wrong: they could not be asked.",
    ),
    FindingCode.NON_UNIT_QUATERNIONS: Guidance(
        "Poses printed with few digits or averaged.",
        "Normalise the quaternions and adjust again.",
        "That it was repaired here: it was audited as it stands, as COLMAP reads it.",
    ),
    FindingCode.NON_FINITE_POSES: Guidance(
        "An optimisation that diverged.",
        "Remove these images and register them again.",
        "Anything about their cameras.",
    ),
    FindingCode.NON_FINITE_POINTS: Guidance(
        "Points triangulated from parallel rays.",
        "Remove these points.",
        "Anything about the images that see them.",
    ),
    FindingCode.NON_FINITE_CAMERAS: Guidance(
        "An optimisation that diverged; a converter that divided by zero.",
        "Set the cameras to an initial guess and adjust again.",
        "Anything about the poses of their images.",
    ),
    FindingCode.NON_FINITE_OBSERVATIONS: Guidance(
        "A keypoint file with holes; a converter.",
        "Import the keypoints again.",
        "Anything about the images beyond these points.",
    ),
    FindingCode.NON_FINITE_UNUSED: Guidance(
        "A writer that fills unused fields with anything.",
        "Nothing.",
        "That the audit used these numbers.",
    ),
    FindingCode.OBSERVATIONS_OUTSIDE: Guidance(
        "Undistorted photos whose border was cut, a camera of another resolution, width and height exchanged.",
        "A few: nothing. Many: compare the sizes of cameras and photos.",
        "That the observations are wrong: an undistorted keypoint may fall outside.",
    ),
    FindingCode.IMAGE_SIZE_SWAPPED: Guidance(
        "Portrait photos whose EXIF orientation was applied to the photo and not to the camera.",
        "Exchange width and height of the cameras.",
        "That coverage and focal ratio are right as they stand.",
    ),
    FindingCode.DUPLICATE_NAMES: Guidance(
        "Folders merged into one; a photo registered twice.",
        "Name images with their folder, or go by id.",
        "That a list of names tells such images apart.",
    ),
    FindingCode.INCOMPLETE_RIGS: Guidance(
        "One of the two files of rigs and frames was not copied; images that belong to no frame.",
        "Copy both files, or export the model without rigs.",
        "That poses in the images file were used where both files are there: they are not.",
    ),
    FindingCode.SENSORS_DISAGREE: Guidance(
        "Camera ids renumbered in one of the files.",
        "Write the model again from one program.",
        "That the camera of an image is the one that its rig means.",
    ),
    FindingCode.IMPLAUSIBLE_CAMERAS: Guidance(
        "A focal length that ran away, a size of 0, a distortion of 1e6.",
        "Set the cameras to an initial guess and adjust again.",
        "That their small residuals vouch for them.",
    ),
    FindingCode.EXTREME_VALUES: Guidance(
        "An optimisation that diverged; mixed units.",
        "Remove or repair the numbers named.",
        "Anything about the images that hold them.",
    ),
    FindingCode.EMPTY_MODEL: Guidance(
        "Known poses prepared for triangulation; a reconstruction that failed.",
        "Triangulate first, or choose the component that holds the images.",
        "That the poses are right or wrong: without points nothing speaks.",
    ),
    FindingCode.STATED_COUNT_DIFFERS: Guidance(
        "A text file that was edited or cut.",
        "Export the model again, and compare the counts.",
        "That all records are there.",
    ),
    FindingCode.UNTERMINATED_TEXT: Guidance(
        "A copy or a download that was cut.",
        "Copy the file again.",
        "That the last number is whole.",
    ),
    FindingCode.EXACT_PROJECTIONS: Guidance(
        "A rendered data set, or a converter that projected points instead of keeping keypoints.",
        "Audit the model that holds the detected keypoints.",
        "That the cameras are perfect.",
    ),
    FindingCode.POINTS_NOT_OPTIMAL: Guidance(
        "Points from another source or of another time than the cameras; a filter after the last adjustment.",
        "Run bundle adjustment, or triangulate the points again.",
        "That the cameras are wrong: the points alone would take up this share.",
    ),
    FindingCode.TRACK_STATISTICS_FROM_ALL_IMAGES: Guidance(
        "Most poses were changed after the last adjustment.",
        "Run bundle adjustment and audit again.",
        "Anything by KS or the noise until then: the tracks that predict the noise are off themselves.",
    ),
    FindingCode.PARTS_DISAGREE: Guidance(
        "Another resolution of photos than of cameras, poses inverted or shifted by one image, axes flipped, "
        "quaternions in another order: a converter, nearly always.",
        "Repair the converter; the cause is named where it can be read. Do not use the model until then.",
        "Anything about lens or noise.",
    ),
    FindingCode.POINTS_BEHIND: Guidance(
        "Axes flipped (OpenGL, Blender) or poses stored as world-from-camera.",
        "Turn y and z round, or invert the poses.",
        "Anything else about the model.",
    ),
    FindingCode.IMAGES_DISAGREE: Guidance(
        "Single images of another size, or registered to the wrong place.",
        "Look at the images named; register them again.",
        "That the other images suffer: these are left out of everything shared.",
    ),
    FindingCode.PIXEL_CONVENTION: Guidance(
        "Keypoints whose first pixel centre is (0, 0).",
        "Add 0.5 to the keypoints when they are imported.",
        "That the poses are wrong by more than 0.02 to 0.03 degrees.",
    ),
    FindingCode.ROUNDED_POSES: Guidance(
        "Poses that went through a file with few decimals.",
        "Keep all digits, or run bundle adjustment after reading the poses.",
        "That the reconstruction was bad: it was printed badly.",
    ),
    FindingCode.IMPLIED_PRINCIPAL_POINT: Guidance(
        "Cropped photos; a principal point that COLMAP did not free (its default).",
        "Adjust with the principal point free, if directions matter to you.",
        "That images are rejected for it: it leaves hardly any residual.",
    ),
    FindingCode.IMPLIED_RADIAL: Guidance(
        "A lens that needs one more radial term.",
        "Refit with the next larger radial model.",
        "That poses are off by much: see what the misfit of its images is worth.",
    ),
    FindingCode.IMPLIED_ASPECT: Guidance(
        "Photos scaled differently in x and y; video pixels.",
        "Refit with fx and fy (PINHOLE, OPENCV).",
        "That it is the sensor: rolling shutter of a moving camera looks alike.",
    ),
    FindingCode.IMPLIED_TANGENTIAL: Guidance(
        "A decentred lens; a principal point that nobody freed.",
        "Free the principal point first, then refit as OPENCV.",
        "Which of the two it is.",
    ),
    FindingCode.JOINT_IN_BLOCKS: Guidance(
        "A model too large for one system in memory.",
        "Nothing.",
        "That deviations between blocks are seen: each block takes its border as given.",
    ),
    FindingCode.NOISE_PRIOR_NOT_CONVERGED: Guidance(
        "Few tracks, or residuals of two very different kinds.",
        "Decide by the policy camera, which does not ask about noise.",
        "That KS and verdict_noise of this model mean what they say elsewhere.",
    ),
    FindingCode.CONTRADICTED_PAIRS: Guidance(
        "False matches that the mapper rightly left out (a repeated facade), or a model folded over itself.",
        "Look at the pairs named; reconstruct without the matches that only one side supports.",
        "That the model is folded: right models of symmetric buildings contradict 40 to 52 % of their strong pairs.",
    ),
    FindingCode.DATABASE_NOT_USED: Guidance(
        "The database was not copied with the model, or images were renamed after matching.",
        "Name it with --database, or leave the option out.",
        "Anything about pairs: none was asked.",
    ),
    FindingCode.DISCONNECTED: Guidance(
        "Two parts merged without common points; points that were filtered away.",
        "Match across the gap and adjust again, or treat the parts as two models.",
        "That distances between the parts mean anything.",
    ),
    FindingCode.WEAKLY_CONNECTED: Guidance(
        "Few overlapping photos between two parts; one image that holds them together.",
        "Match across the gap, or take photos there.",
        "That the parts are wrong in themselves: only their place relative to each other is.",
    ),
    FindingCode.RIG_POSE_DISAGREES: Guidance(
        "A model that was edited in the images file alone, or exported without its frames.",
        "Write the model again from one program; poses of frames and rigs come first, as in COLMAP.",
        "That the poses of the images file were audited.",
    ),
    FindingCode.RIG_NOT_CONSTANT: Guidance(
        "A rig that moves, cameras that are not taken at one time, a wrong sensor_from_rig.",
        "Free sensor_from_rig in the adjustment, or treat the images as single ones.",
        "That the image named is at fault: the rig may be.",
    ),
    FindingCode.IMAGE_SIZE_ASSUMED: Guidance(
        "Bundler, BAL and VisualSFM files hold no image sizes.",
        "Convert to a format with sizes where coverage, folds or focal ratios matter to you.",
        "That coverage and focal_over_size are exact: they rest on the size that was taken.",
    ),
    FindingCode.OBSERVATIONS_WITHOUT_IMAGE: Guidance(
        "Images that were listed and not placed; a file that was cut by hand.",
        "Nothing, unless they are many: then export the model again.",
        "That these observations were audited.",
    ),
    FindingCode.SEVERAL_RECONSTRUCTIONS: Guidance(
        "A VisualSFM file with all components of a collection.",
        "Export the component you mean, or take each for itself.",
        "That their scales or places relative to each other mean anything.",
    ),
    FindingCode.POSSIBLE_FOLD: Guidance(
        "Opposite sides of a symmetric building put together; day and night; a loop that was not closed.",
        "Compare with another reconstruction (check --baseline) or ask a database; filter --keep-group keeps a side.",
        "That the model is folded: one in four right models of real photos looks so.",
    ),
    FindingCode.REFERENCE_NOT_USED: Guidance(
        "The reference of other images, names that do not fit it, poses of another body than the camera, or poses "
        "stored the other way round (camera from world, world from camera).",
        "Name the reference of these photos with --reference, its poses as docs/witnesses.md says of its format.",
        "Anything about the reference: it was not asked.",
    ),
    FindingCode.REFERENCE_SCALE: Guidance(
        "A reconstruction from photos alone has no scale; a metric one says 1 here.",
        "Nothing, unless the model was meant to be metric: then look at its scale bars, rig or priors.",
        "That the model is wrong: only its unit is another one.",
    ),
    FindingCode.REFERENCE_DRIFT: Guidance(
        "A long sequence without loops, a focal length that is a little off, rolling shutter; a reference that drifts.",
        "Close loops, use control points or priors in the adjustment; compare with a second reference.",
        "Which of the two bends.",
    ),
    FindingCode.REFERENCE_FRAGMENTS: Guidance(
        "A fold, a part glued on by few matches, two components merged by a wrong transformation.",
        "Look at the matches between the fragment and the rest; or reconstruct the parts one by one.",
        "That the smaller group is the wrong one.",
    ),
    FindingCode.PRIORS_NOT_USED: Guidance(
        "A database without priors, photos without GPS, names that do not fit, fewer than six priors; swapped columns, "
        "another unit, or a place smaller than the noise of the sensor.",
        "Look at names, columns and unit of the priors, or leave --priors out.",
        "Anything about priors: none were asked.",
    ),
    FindingCode.PRIORS_SCALE: Guidance(
        "A reconstruction from photos alone has no scale; a metric one says 1 here.",
        "Nothing, unless the model was meant to be metric: then look at its scale bars or rig.",
        "That the model is wrong: only its unit is another one.",
    ),
    FindingCode.PRIORS_DRIFT: Guidance(
        "A long strip that bends (a bowl or a banana), or GPS whose error changes slowly, as it mostly does.",
        "Compare the length with the accuracy of the sensor; adjust with priors or control points.",
        "Which of the two drifts: errors of GPS are alike for minutes.",
    ),
    FindingCode.PRIORS_SPREAD: Guidance(
        "Covariances that are too small, a lever arm between antenna and camera, clocks that differ, a bent model.",
        "Give covariances that hold; they are taken as that much larger here.",
        "That single images are wrong: those are judged by the spread of all.",
    ),
}
