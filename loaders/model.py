"""The one model every loader fills and the audit reads: flat arrays, one block per table.

Frames: ``world`` is the reconstruction's frame, ``cam`` the camera's (x right, y down, z forward). Image points are
in pixels of the distorted image, centre of the first pixel at (0.5, 0.5). Ids are the stored ones, ``*_idx`` are rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

import numpy as np

from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray, UInt32Array, UInt64Array
from sfm_audit.loaders.camera_models import BY_ID, CameraModel


class FindingCode(StrEnum):
    """What can be wrong with a model that is nevertheless readable. A closed list, documented in docs/findings.md."""

    BINARY_TEXT_DISAGREE = "binary_text_disagree"
    TRACKS_DISAGREE = "tracks_disagree"
    DANGLING_POINT_IDS = "dangling_point_ids"
    UNSEEN_POINTS = "unseen_points"
    SHORT_TRACKS = "short_tracks"
    REPEATED_OBSERVATIONS = "repeated_observations"
    STORED_ERRORS_ZERO = "stored_errors_zero"
    STORED_ERRORS_MISSING = "stored_errors_missing"
    STORED_ERRORS_STALE = "stored_errors_stale"
    ORPHAN_CAMERAS = "orphan_cameras"
    MISSING_CAMERAS = "missing_cameras"
    NON_UNIT_QUATERNIONS = "non_unit_quaternions"
    NON_FINITE_POSES = "non_finite_poses"
    NON_FINITE_POINTS = "non_finite_points"
    NON_FINITE_CAMERAS = "non_finite_cameras"
    NON_FINITE_OBSERVATIONS = "non_finite_observations"
    NON_FINITE_UNUSED = "non_finite_unused"
    OBSERVATIONS_OUTSIDE = "observations_outside"
    IMAGE_SIZE_SWAPPED = "image_size_swapped"
    DUPLICATE_NAMES = "duplicate_names"
    INCOMPLETE_RIGS = "incomplete_rigs"
    SENSORS_DISAGREE = "sensors_disagree"
    IMPLAUSIBLE_CAMERAS = "implausible_cameras"
    EXTREME_VALUES = "extreme_values"
    EMPTY_MODEL = "empty_model"
    STATED_COUNT_DIFFERS = "stated_count_differs"
    UNTERMINATED_TEXT = "unterminated_text"
    EXACT_PROJECTIONS = "exact_projections"
    POINTS_NOT_OPTIMAL = "points_not_optimal"
    TRACK_STATISTICS_FROM_ALL_IMAGES = "track_statistics_from_all_images"
    PARTS_DISAGREE = "parts_disagree"
    POINTS_BEHIND = "points_behind"
    IMAGES_DISAGREE = "images_disagree"
    PIXEL_CONVENTION = "pixel_convention"
    ROUNDED_POSES = "rounded_poses"
    IMPLIED_PRINCIPAL_POINT = "implied_principal_point"
    IMPLIED_RADIAL = "implied_radial"
    IMPLIED_ASPECT = "implied_aspect"
    IMPLIED_TANGENTIAL = "implied_tangential"
    JOINT_IN_BLOCKS = "joint_in_blocks"
    NOISE_PRIOR_NOT_CONVERGED = "noise_prior_not_converged"
    CONTRADICTED_PAIRS = "contradicted_pairs"
    DATABASE_NOT_USED = "database_not_used"
    DISCONNECTED = "disconnected"
    WEAKLY_CONNECTED = "weakly_connected"
    RIG_POSE_DISAGREES = "rig_pose_disagrees"
    RIG_NOT_CONSTANT = "rig_not_constant"
    IMAGE_SIZE_ASSUMED = "image_size_assumed"
    OBSERVATIONS_WITHOUT_IMAGE = "observations_without_image"
    SEVERAL_RECONSTRUCTIONS = "several_reconstructions"
    POSSIBLE_FOLD = "possible_fold"
    REFERENCE_NOT_USED = "reference_not_used"
    REFERENCE_SCALE = "reference_scale"
    REFERENCE_DRIFT = "reference_drift"
    REFERENCE_FRAGMENTS = "reference_fragments"
    PRIORS_NOT_USED = "priors_not_used"
    PRIORS_SCALE = "priors_scale"
    PRIORS_DRIFT = "priors_drift"
    PRIORS_SPREAD = "priors_spread"


FINDING_MEANINGS: Final[dict[FindingCode, str]] = {
    FindingCode.BINARY_TEXT_DISAGREE: "binary and text files lie in one folder and differ in counts; binary was read",
    FindingCode.TRACKS_DISAGREE: "tracks and images name different observations; the images' own point ids were read",
    FindingCode.DANGLING_POINT_IDS: "linked 2D points name a 3D point that the model does not have (num_dangling)",
    FindingCode.UNSEEN_POINTS: "3D points to which no image links",
    FindingCode.SHORT_TRACKS: "3D points to which a single 2D point links",
    FindingCode.REPEATED_OBSERVATIONS: "linked 2D points that repeat a 3D point which their image has linked already",
    FindingCode.STORED_ERRORS_ZERO: "the stored errors of all 3D points are 0: nobody computed them",
    FindingCode.STORED_ERRORS_MISSING: "3D points without a stored error (COLMAP's -1, or no number)",
    FindingCode.STORED_ERRORS_STALE: "stored point errors that the model does not have (more than 1 % of the points)",
    FindingCode.ORPHAN_CAMERAS: "cameras that belong to no image",
    FindingCode.MISSING_CAMERAS: "images whose camera does not exist; they are undetermined",
    FindingCode.NON_UNIT_QUATERNIONS: "rotation quaternions of a length other than 1; not normalised, as in COLMAP",
    FindingCode.NON_FINITE_POSES: "images whose pose is not finite; they are undetermined",
    FindingCode.NON_FINITE_POINTS: "3D points that are not finite; their projections count as num_nonfinite",
    FindingCode.NON_FINITE_CAMERAS: "cameras with parameters that are not finite; their images are undetermined",
    FindingCode.NON_FINITE_OBSERVATIONS: "linked 2D points that are not finite",
    FindingCode.NON_FINITE_UNUSED: "unlinked 2D points, colours or replaced poses that are no numbers; not used here",
    FindingCode.OBSERVATIONS_OUTSIDE: "linked 2D points outside of their image",
    FindingCode.IMAGE_SIZE_SWAPPED: "cameras whose principal point says that width and height are swapped",
    FindingCode.DUPLICATE_NAMES: "images that share their name with another one",
    FindingCode.INCOMPLETE_RIGS: "rigs and frames do not place all images, or one of their files is missing",
    FindingCode.SENSORS_DISAGREE: "rigs, frames, cameras and images name different sensors for each other",
    FindingCode.IMPLAUSIBLE_CAMERAS: "cameras with a size, focal length or distortion that no camera has",
    FindingCode.EXTREME_VALUES: "poses, points, 2D points or stored errors that are finite and above 1e12 in magnitude",
    FindingCode.EMPTY_MODEL: "the model has no images, or no 3D points",
    FindingCode.STATED_COUNT_DIFFERS: "a text file says in its head that it holds another number of records",
    FindingCode.UNTERMINATED_TEXT: "a text file does not end its last line: its last number may be cut",
    FindingCode.EXACT_PROJECTIONS: "images whose 2D points are projections of the 3D points, not measurements",
    FindingCode.POINTS_NOT_OPTIMAL: "moving the 3D points alone would remove much of the residuals (removable_share)",
    FindingCode.PARTS_DISAGREE: "cameras, poses, points and 2D points do not belong together; no lens is diagnosed",
    FindingCode.POINTS_BEHIND: "all observations lie behind their cameras: axes flipped, or poses inverted?",
    FindingCode.IMAGES_DISAGREE: "images whose camera, pose, points and 2D points do not belong together",
    FindingCode.PIXEL_CONVENTION: "all observations are shifted by half a pixel: another convention of pixel centres",
    FindingCode.ROUNDED_POSES: "all poses are rounded to a few decimals: somebody printed them, and pixels were lost",
    FindingCode.IMPLIED_PRINCIPAL_POINT: "adjusting the principal point, which nobody freed, would move it by so much",
    FindingCode.IMPLIED_RADIAL: "the next radial coefficient, which the camera model lacks, would be so large",
    FindingCode.IMPLIED_ASPECT: "fx / fy, which the camera model takes as 1, would be so much",
    FindingCode.IMPLIED_TANGENTIAL: "p1 and p2, which the camera model lacks, would be so large",
    FindingCode.JOINT_IN_BLOCKS: "the model is too large for one joint system; it was solved in blocks of covisibility",
    FindingCode.NOISE_PRIOR_NOT_CONVERGED: "the prior of the track noise did not converge: KS rests on what it reached",
    FindingCode.IMAGE_SIZE_ASSUMED: "the format stores no image sizes; one that holds all observations was taken",
    FindingCode.OBSERVATIONS_WITHOUT_IMAGE: "observations of images that have no pose or do not exist; not read",
    FindingCode.SEVERAL_RECONSTRUCTIONS: "the file holds several reconstructions, each with its own points and scale",
    FindingCode.TRACK_STATISTICS_FROM_ALL_IMAGES: "too many images are away from their optimum to leave them out",
    FindingCode.CONTRADICTED_PAIRS: "verified pairs that the cameras contradict: a fold, or false pairs left out",
    FindingCode.DATABASE_NOT_USED: "there is no database.db, or it does not fit the model: its pairs were not asked",
    FindingCode.DISCONNECTED: "parts of the model share too few points: their poses relative to each other are free",
    FindingCode.WEAKLY_CONNECTED: "parts of the model hang together by few points, or by one image or pair alone",
    FindingCode.RIG_POSE_DISAGREES: "poses in the images file differ from those of frames and rigs, which were read",
    FindingCode.RIG_NOT_CONSTANT: "images of a rig would move against their frame: the rig is not rigid, or misplaced",
    FindingCode.POSSIBLE_FOLD: "two groups side by side see other points: missing matches, two times of day, or a fold",
    FindingCode.REFERENCE_NOT_USED: "the reference has nothing on the model, or no part of it fits: it was not asked",
    FindingCode.REFERENCE_SCALE: "how long a unit of the model is in the metres of its reference",
    FindingCode.REFERENCE_DRIFT: "neighbours in the sequence share their distance from the reference: the model bends",
    FindingCode.REFERENCE_FRAGMENTS: "images that lie together elsewhere than the reference has them",
    FindingCode.PRIORS_NOT_USED: "there are no position priors for the model, too few, or they do not fit: not asked",
    FindingCode.PRIORS_SCALE: "how long a unit of the model is in the metres of its position priors",
    FindingCode.PRIORS_DRIFT: "neighbours in the sequence share their distance from the priors: model or sensor drift",
    FindingCode.PRIORS_SPREAD: "position priors scatter more widely about the model than their covariances say",
}
"""One line per finding, for docs/findings.md."""


@dataclass(frozen=True, slots=True)
class Finding:
    """An inconsistency of a readable model: a code, how many items it concerns, one line for people."""

    code: FindingCode
    count: int
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class CameraRecord:
    """One camera: ``params`` (num_params,) float64 in the order of ``model.param_names``, px and dimensionless."""

    camera_id: int
    model: CameraModel
    width: int
    height: int
    params: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """One registered image.

    camera: None when the model has no camera of that id.
    quat_cam_from_world_wxyz: (4,) as stored; not normalised (COLMAP does not normalise it either).
    translation_cam_from_world: (3,), model units.
    """

    image_id: int
    name: str
    camera_id: int
    camera: CameraRecord | None
    quat_cam_from_world_wxyz: FloatArray
    translation_cam_from_world: FloatArray
    num_points2d: int

    @property
    def rotation_cam_from_world(self) -> FloatArray:
        """(3, 3) matrix of the quaternion."""
        return rotation_from_quat(self.quat_cam_from_world_wxyz)

    def cam_from_world(self, xyz_world: FloatArray) -> FloatArray:
        """Move (n, 3) points from the world to the camera frame, model units, see `moved`."""
        return moved(self.quat_cam_from_world_wxyz, self.translation_cam_from_world, xyz_world)


@dataclass(frozen=True, slots=True, eq=False)
class CameraTable:
    """All cameras, sorted by camera_id. ``params`` of camera i = params[param_offsets[i]:param_offsets[i + 1]]."""

    camera_id: UInt32Array
    model_id: IntArray
    width: IntArray
    height: IntArray
    params: FloatArray
    param_offsets: IntArray

    def __len__(self) -> int:
        return len(self.camera_id)


@dataclass(frozen=True, slots=True, eq=False)
class ImageTable:
    """All registered images, sorted by image_id.

    camera_idx: (I,) row of CameraTable, -1 where the camera does not exist.
    quat_cam_from_world_wxyz: (I, 4) as stored (or composed from rigs and frames), not normalised.
    translation_cam_from_world: (I, 3) model units.    num_points2d: (I,) all 2D points, linked or not.
    frame_idx: (I,) images of equal number were placed by one pose of their rig; None where no two images were.
    pose_cam_from_rig: (I, 7) quaternion w x y z as stored and translation, identity for images that no rig places.
    """

    image_id: UInt32Array
    name: tuple[str, ...]
    camera_id: UInt32Array
    camera_idx: IntArray
    quat_cam_from_world_wxyz: FloatArray
    translation_cam_from_world: FloatArray
    num_points2d: IntArray
    frame_idx: IntArray | None = None
    pose_cam_from_rig: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.image_id)


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """All 3D points, sorted by point3d_id. stored_error_px: (P,) as stored, -1 where COLMAP has none."""

    point3d_id: UInt64Array
    xyz_world: FloatArray
    stored_error_px: FloatArray

    def __len__(self) -> int:
        return len(self.point3d_id)


@dataclass(frozen=True, slots=True, eq=False)
class ObservationTable:
    """All *linked* 2D points (those with a point id), by image in ImageTable order, then by POINTS2D order.

    offsets: (I + 1,), image i owns rows offsets[i]:offsets[i + 1].    point2d_idx: (M,) position in POINTS2D.
    xy_px: (M, 2).    point_idx: (M,) int32, row of PointTable, -1 where the point does not exist (dangling).
    """

    offsets: IntArray
    point2d_idx: UInt32Array
    xy_px: FloatArray
    point_idx: Int32Array

    def __len__(self) -> int:
        return len(self.point_idx)


@dataclass(frozen=True, slots=True, eq=False)
class SparseModel:
    """A reconstruction, columnar; links are those of the images' own point ids.

    location: as given to `open_model`.    file_format: name of the format it was read from, see `loaders.formats`.
    """

    location: str
    file_format: str
    cameras: CameraTable
    images: ImageTable
    points: PointTable
    observations: ObservationTable
    findings: tuple[Finding, ...]

    def __repr__(self) -> str:
        sizes = f"{len(self.images)} images, {len(self.cameras)} cameras, {len(self.points)} points"
        return f"<SparseModel {self.location!r}, {self.file_format}: {sizes}, {len(self.observations)} observations>"

    def camera(self, camera_idx: int) -> CameraRecord:
        """Return the camera in row ``camera_idx`` of the camera table."""
        table = self.cameras
        first, last = table.param_offsets[camera_idx : camera_idx + 2]
        return CameraRecord(
            int(table.camera_id[camera_idx]),
            BY_ID[int(table.model_id[camera_idx])],
            int(table.width[camera_idx]),
            int(table.height[camera_idx]),
            table.params[first:last],
        )

    def image(self, image_idx: int) -> ImageRecord:
        """Return the image in row ``image_idx`` of the image table."""
        table = self.images
        camera_idx = int(table.camera_idx[image_idx])
        return ImageRecord(
            int(table.image_id[image_idx]),
            table.name[image_idx],
            int(table.camera_id[image_idx]),
            None if camera_idx < 0 else self.camera(camera_idx),
            table.quat_cam_from_world_wxyz[image_idx],
            table.translation_cam_from_world[image_idx],
            int(table.num_points2d[image_idx]),
        )

    def image_idx(self, name: str) -> int:
        """Return the row of the image called ``name`` (or ``id:<image_id>``); KeyError when there is none."""
        if name in self.images.name:
            return self.images.name.index(name)
        if name.startswith("id:") and name[3:].isdigit():
            rows = np.flatnonzero(self.images.image_id == int(name[3:]))
            if len(rows):
                return int(rows[0])
        raise KeyError(name)


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPair:
    """Verified matches of two images.

    first_idx, second_idx: rows of ImageTable.    keypoint_idx: (m, 2) positions in POINTS2D of both.
    """

    first_idx: int
    second_idx: int
    keypoint_idx: UInt32Array


class PairSource(Protocol):
    """Where verified matches come from, a pair at a time: there may be more of them than memory holds."""

    def pairs(self) -> Iterator[MatchedPair]:
        """Go through the verified pairs whose two images the model has; LoadError where they cannot be read."""
        ...

    def keypoints_px(self, image_idx: int) -> FloatArray:
        """Return (num_points2d, 2) all 2D points of the image, px; LoadError where they cannot be read."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class InlierSet:
    """The 2D-3D inliers of one image (method.md section 1); row i of every array is the same observation.

    xy_px: (n, 2) float64, observed, distorted; first pixel centre = (0.5, 0.5).
    xyz_world: (n, 3) float64, model units.      point_idx: (n,) int64, rows of SparseModel.points.
    The other counts say what was linked but is no inlier: point missing, behind the camera, projection not finite.
    """

    image: ImageRecord
    xy_px: FloatArray
    xyz_world: FloatArray
    point_idx: IntArray
    num_dangling: int = 0
    num_behind: int = 0
    num_nonfinite: int = 0

    def __repr__(self) -> str:
        return f"<InlierSet of {self.image.name!r}: {len(self.xy_px)} inliers>"


def rotation_from_quat(quat_wxyz: FloatArray) -> FloatArray:
    """Return (..., 3, 3) matrices of (..., 4) quaternions w x y z, without normalising them, like COLMAP."""
    w, x, y, z = np.moveaxis(np.asarray(quat_wxyz, dtype=np.float64), -1, 0)
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):  # not finite: not finite in the matrix either
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    if w.ndim == 0:
        return np.array(rows)
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def moved(quat_wxyz: FloatArray, translation: FloatArray, xyz: FloatArray) -> FloatArray:
    """Move (n, 3) points by a quaternion (4,) and a translation (3,), or each by its own: (4, n) and (3, n).

    Notes
    -----
    In Eigen's order of operations (v + w u + q x u with u = 2 q x v): a point at 1e-10 units from the camera centre
    then projects to where COLMAP projects it; a matrix product would round it elsewhere. Each coordinate of the result
    is contiguous.
    """
    w, qx, qy, qz = quat_wxyz
    x, y, z = np.ascontiguousarray(xyz.T)
    out = np.empty(xyz.shape, order="F")
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):  # what is not finite projects nowhere
        ux, uy, uz = qy * z - qz * y, qz * x - qx * z, qx * y - qy * x
        ux, uy, uz = ux + ux, uy + uy, uz + uz
        out[:, 0] = x + w * ux + (qy * uz - qz * uy) + translation[0]
        out[:, 1] = y + w * uy + (qz * ux - qx * uz) + translation[1]
        out[:, 2] = z + w * uz + (qx * uy - qy * ux) + translation[2]
    return out
