"""What the score tests need of a model's observations, summed up for some images at once: compiled, or with numpy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.audit.inliers.projected import cams_from_gradients, image_inliers
from sfm_audit.audit.inliers.residuals import ModelResiduals
from sfm_audit.audit.kernels import kernels_in_use
from sfm_audit.audit.kernels.misfit import (
    MAX_OWN,
    NUM_FEATURES,
    Observed,
    Tracks,
    Window,
    misfit_meat,
    misfit_mixed,
    misfit_sums,
    misfit_tracks,
)
from sfm_audit.audit.misfit.clusters import pixels
from sfm_audit.audit.misfit.features import (
    ImageFeatures,
    affine_offset,
    image_features,
    meat_of,
    mixed_of,
    packed,
    scores_of,
    sums_of,
    unpacked,
    weights_of,
)
from sfm_audit.audit.misfit.fields import OWN_COEFFICIENTS
from sfm_audit.audit.misfit.in_parts import AT_ONCE
from sfm_audit.audit.misfit.nuisance import fitted_param_idxs
from sfm_audit.audit.misfit.pooled import add_rows
from sfm_audit.audit.misfit.score import Clusters
from sfm_audit.audit.table.words import MisfitGroup
from sfm_audit.loaders.arrays import FloatArray, Int32Array, IntArray, distinct
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord, SparseModel

_MAX_IMAGES: Final = 64
_FEW_OF_POINTS: Final = 8  # observations of fewer than this share of the model's points are sorted
_MAX_OBSERVATIONS: Final = 1 << 17
_FEW_OBSERVATIONS: Final = 1 << 14  # whose features are in memory at the same time


class NumberedTracks(NamedTuple):
    """Tracks of some images, numbered from 0.

    of_row: (n,) number of each observation's track, of the rows of these images.    num_tracks: how many.
    reach: (k, 2) smallest and largest number of each image; the second is below the first where it has none.
    """

    of_row: Int32Array
    num_tracks: int
    reach: IntArray


class ModelSums:
    """Sums over the observations of images of one model, compiled where there are kernels.

    Make one for all questions about a model: its arrays are checked once.

    Parameters
    ----------
    model, residuals : the model and its inliers
    known : by row of the image table, `packed` sums of images that were summed up before
    """

    def __init__(
        self, model: SparseModel, residuals: ModelResiduals, known: Mapping[int, FloatArray] | None = None
    ) -> None:
        self.model, self.residuals, self.known = model, residuals, known or {}
        self._cameras: dict[int, CameraRecord] = {}

    @cached_property
    def observed(self) -> Observed:
        """What kernels take of the model."""
        residuals = self.residuals
        return Observed.of(
            self.model.points.xyz_world,
            self.model.observations.xy_px,
            (residuals.point_idx, residuals.observation_row),
            residuals.residuals_px,
            residuals.point_jacobian,
        )

    def camera(self, image: int) -> CameraRecord:
        """Of the image in this row, which has inliers."""
        camera_idx = int(self.model.images.camera_idx[image])
        if camera_idx not in self._cameras:
            self._cameras[camera_idx] = self.model.camera(camera_idx)
        return self._cameras[camera_idx]

    def shares_camera(self, image: int) -> bool:
        """Whether another image has the camera of the image in this row."""
        return bool(self._num_images_of_camera[self.model.images.camera_idx[image]] > 1)

    @cached_property
    def _num_images_of_camera(self) -> IntArray:
        camera_idx = self.model.images.camera_idx
        return np.bincount(camera_idx[camera_idx >= 0], minlength=1)

    def num_of(self, image: int) -> int:
        """Inliers of the image in this row."""
        rows = self.residuals.rows(image)
        return int(rows.stop - rows.start)

    def keypoints(self, image: int) -> FloatArray:
        """(n, 2) observed, of the image in this row."""
        row = self.residuals.observation_row[self.residuals.rows(image)]
        return self.model.observations.xy_px.take(row, axis=0)

    def points(self, image: int) -> IntArray:
        """(n,) rows of the points that the image in this row sees."""
        return self.residuals.point_idx[self.residuals.rows(image)].astype(np.int64)

    def points_of(self, images: Sequence[int]) -> IntArray:
        """Return the points that these images see, ascending rows of the point table."""
        seen_by = [self.points(image) for image in images]
        if _FEW_OF_POINTS * sum(map(len, seen_by)) < len(self.model.points):
            return distinct(np.concatenate(seen_by))
        seen = np.zeros(len(self.model.points), dtype=np.bool_)
        for points in seen_by:
            seen[points] = True
        return np.flatnonzero(seen).astype(np.int64)

    def num_points_of(self, images: Sequence[int]) -> int:
        """Return how many points these images see; nothing is sorted where it is one image."""
        if len(images) != 1:
            return len(self.points_of(images))
        points = self.points(images[0])
        place = np.arange(len(points), dtype=np.int32)
        self._last_place[points] = place
        return int(np.count_nonzero(self._last_place[points] == place))  # of a point seen twice one place is left

    @cached_property
    def _last_place(self) -> Int32Array:
        return np.empty(len(self.model.points), dtype=np.int32)  # read where it was just written

    def tracks(self, images: Sequence[int]) -> NumberedTracks:
        """Number the points that these images see, in the order in which they first see them.

        Images beside each other mostly see the same points, whose numbers then lie near each other. Rows of other
        images hold what an earlier question left: cameras are many, and their images few.
        """
        of_point, of_row, num_tracks = self._track_of_point, self._track_of_row, 0
        reach = np.empty((len(images), 2), dtype=np.int64)
        for place, image in enumerate(images):
            points = self.points(image)
            new = points[of_point[points] < 0]
            of_point[new] = number = np.arange(num_tracks, num_tracks + len(new), dtype=np.int32)
            if not (of_point[new] == number).all():  # points that the image sees twice
                new = distinct(new)
                of_point[new] = number[: len(new)]
            num_tracks += len(new)
            of_row[self.residuals.rows(image)] = own = of_point[points]
            reach[place] = own.min(initial=num_tracks), own.max(initial=-1)
        for image in images:
            of_point[self.points(image)] = -1
        return NumberedTracks(of_row, num_tracks, reach)

    @cached_property
    def _track_of_point(self) -> Int32Array:
        return np.full(len(self.model.points), -1, dtype=np.int32)

    @cached_property
    def _track_of_row(self) -> Int32Array:
        return np.full(len(self.residuals.point_idx), -1, dtype=np.int32)

    def can_sum(self, image: int) -> bool:
        """Whether the image in this row has fields, and room for its columns."""
        model, num = self.camera(image).model, self.num_of(image)
        if model.is_spherical or not num:
            return False
        compiled = kernels_in_use() and 6 + len(fitted_param_idxs(model)) <= MAX_OWN
        return compiled or num <= AT_ONCE

    def features(self, images: Sequence[int]) -> Iterator[ImageFeatures]:
        """Yield the features of the images in these rows."""
        turns = cams_from_gradients(self.model.images.quat_cam_from_world_wxyz[np.array(images, dtype=np.int64)])
        for image, turn in zip(images, turns, strict=True):
            yield image_features(image_inliers(self.model, self.residuals, image, cam_from_gradient=turn))

    def windows(self, images: Sequence[int]) -> Iterator[WindowSums]:
        """Yield images of one camera model, as many as are summed up at a time; each of them `can_sum`."""
        largest = _MAX_OBSERVATIONS if kernels_in_use() else _FEW_OBSERVATIONS
        by_model: dict[str, list[int]] = {}
        for image in images:
            by_model.setdefault(self.camera(image).model.name, []).append(image)
        for alike in by_model.values():
            window: list[int] = []
            size = 0
            for image in alike:
                if window and (len(window) == _MAX_IMAGES or size + self.num_of(image) > largest):
                    yield WindowSums(self, window)
                    window, size = [], 0
                window.append(image)
                size += self.num_of(image)
            yield WindowSums(self, window)

    def window(self, images: Sequence[int], cameras: Sequence[CameraRecord]) -> Window:
        """Return what kernels take of images of one camera model."""
        offsets, table = self.residuals.offsets, self.model.images
        chosen = np.array(images, dtype=np.int64)
        quats = table.quat_cam_from_world_wxyz[chosen]
        numbers = np.empty((len(images), 22))
        numbers[:, :4], numbers[:, 4:7] = quats, table.translation_cam_from_world[chosen]
        numbers[:, 7:16] = cams_from_gradients(quats).reshape(-1, 9)
        numbers[:, 16:] = [_lens_numbers(camera) for camera in cameras]
        rows = np.stack([offsets[chosen], offsets[chosen + 1]], axis=1).astype(np.int64)
        extra = self.residuals.d_extra.of(images)
        return Window(np.ascontiguousarray(rows), numbers, _facts(cameras[0].model), extra)


def _lens_numbers(camera: CameraRecord) -> tuple[float, ...]:
    focals, centre = camera.model.focal_idxs, camera.model.principal_point_idxs
    wanted = (focals[0], focals[-1], *centre)
    return (*camera.params[list(wanted)].tolist(), float(camera.width), float(camera.height))


def _facts(model: CameraModel) -> IntArray:
    own = OWN_COEFFICIENTS.get(model.name, {})
    names = [*own.get(MisfitGroup.RADIAL, ("", "")), *own.get(MisfitGroup.TANGENTIAL, ("", ""))]
    extras = [model.param_names[i] for i in model.extra_idxs]
    which = [extras.index(name) if name else -1 for name in names]
    is_fisheye = functions_of(model).is_fisheye
    return np.array([len(extras), len(model.focal_idxs), is_fisheye, *which], dtype=np.int64)


class WindowSums:
    """Some images of one camera model. With numpy it holds their features, see `_FEW_OBSERVATIONS`.

    images: (B,) their rows.    num_observations: (B,).    num_own: q, columns of N.
    offset: (B, 2) `affine_offset` of each.
    """

    def __init__(self, source: ModelSums, images: list[int]) -> None:
        self.images = images
        cameras = [source.camera(image) for image in images]
        self.offset = np.array([affine_offset(camera) for camera in cameras])
        self.num_own = 6 + len(fitted_param_idxs(cameras[0].model))
        self.num_observations = np.array([source.num_of(image) for image in images], dtype=np.int64)
        self.model_name = cameras[0].model.name
        self._source, self._cameras = source, cameras

    @property
    def is_compiled(self) -> bool:
        """Whether kernels are asked; then no features are held."""
        return kernels_in_use() and self.num_own <= MAX_OWN

    @cached_property
    def _window(self) -> Window | None:
        return self._source.window(self.images, self._cameras) if self.is_compiled else None

    @cached_property
    def _features(self) -> list[ImageFeatures]:
        return list(self._source.features(self.images))

    def sums(self) -> tuple[FloatArray, FloatArray]:
        """Return `sums_of` each image: (B, q + 40, q + 40) and (B, q + 40)."""
        known = self._source.known
        lacking = [image for image in self.images if image not in known]
        if len(lacking) == len(self.images):
            return self._summed()
        if lacking:
            own = packed(*WindowSums(self._source, lacking).sums(), self.num_own)
            known = {**known, **dict(zip(lacking, own, strict=True))}
        return unpacked(np.stack([known[image] for image in self.images]), self.num_own)

    def _summed(self) -> tuple[FloatArray, FloatArray]:
        if self._window is not None and (found := misfit_sums(self._source.observed, self._window)) is not None:
            return found
        own = [sums_of(features) for features in self._features]
        return np.stack([gram for gram, _ in own]), np.stack([on_y for _, on_y in own])

    def meat(self, basis: FloatArray, on_y: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return the meat (B, q + 40, q + 40) of N and features, largest leverages and numbers of clusters (B,).

        Parameters
        ----------
        basis : (B, q, q) basis N is orthonormal        on_y : (B, q) what N explains of the residuals

        Notes
        -----
        Observations whose keypoints lie in one pixel are one cluster; -1 clusters where the keypoints are out of range.
        """
        if self._window is not None:
            found = misfit_meat(self._source.observed, self._window, basis, on_y)
            if found is not None:
                return found
        size = self.num_own + NUM_FEATURES
        meat, leverage = np.zeros((len(self.images), size, size)), np.zeros(len(self.images))
        num_clusters = self.num_observations.copy()
        for b, features in enumerate(self._features):
            _, weights, leverage[b] = weights_of(features, basis[b], on_y[b])
            g = scores_of(features, weights)
            clusters = self._clusters(b)
            if clusters is not None:
                num_clusters[b] -= clusters.num_merged
                clusters.merge(g)
            meat[b] = meat_of(g, self.num_own)
        return meat, leverage, num_clusters

    def mixed(
        self, basis: FloatArray, on_y: FloatArray, chosen: IntArray, mix: FloatArray, coefficients: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return Gram matrices (k, 28, 28), scores (k, 28) and meat (k, 28, 28) of `mixed_of` chosen images (k,).

        Parameters
        ----------
        basis, on_y : of all images, as in `meat`        mix : (k, 28, 28)        coefficients : (k, q, 28)
        """
        if self._window is not None:
            profile = basis[chosen], on_y[chosen]
            found = misfit_mixed(self._source.observed, self._window.only(chosen), profile, (mix, coefficients))
            if found is not None:
                return found
        gram, scores, meat = np.empty_like(mix), np.empty(mix.shape[:2]), np.empty_like(mix)
        for place, b in enumerate(chosen.tolist()):
            left, weights, _ = weights_of(self._features[b], basis[b], on_y[b])
            columns = mixed_of(self._features[b], mix[place], coefficients[place])
            flat = columns.reshape(len(columns), -1)
            gram[place], scores[place] = flat @ flat.T, flat @ left.reshape(-1)
            g = np.asarray(np.einsum("cin,in->cn", columns, weights))
            clusters = self._clusters(b)
            if clusters is not None:
                clusters.merge(g)
            meat[place] = g @ g.T
        return gram, scores, meat

    def _clusters(self, b: int) -> Clusters | None:
        return Clusters.of(pixels(self._source.keypoints(self.images[b])))

    def forget(self) -> None:
        """Let go of what kernels take of the images: it is made again when it is asked for."""
        self.__dict__.pop("_window", None)

    def add_tracks(
        self, per_track: FloatArray, profile: tuple[FloatArray, FloatArray, FloatArray], tracks: Tracks
    ) -> None:
        """Add what the observations say to their tracks (last - first, 40), in place.

        Parameters
        ----------
        profile : basis (B, r, q), on_y (B, q), coefficients (B, q, 40): features - N coefficients are off N
        """
        if self._window is not None:
            found = misfit_tracks(self._source.observed, self._window, profile, tracks, per_track)
            if found:
                return
        last_row = np.empty(len(per_track), dtype=np.int64)
        for b, features in enumerate(self._features):
            basis, on_y, coefficients = (each[b] for each in profile)
            g = scores_of(features, weights_of(features, basis, on_y).weights)
            own = g[self.num_own :]
            own -= coefficients.T @ g[: self.num_own]
            track = tracks.of_row[self._source.residuals.rows(self.images[b])]
            inside = (track >= tracks.first) & (track < tracks.last)
            chosen = slice(None) if inside.all() else inside
            add_rows(per_track, track[chosen] - tracks.first, own.T[chosen], last_row)
