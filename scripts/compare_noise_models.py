"""Compare how well noise models predict an observation: one constant, keypoint scale, the rest of its track, both.

    python scripts/compare_noise_models.py FOLDER     COLMAP models below FOLDER that have a database.db
    python scripts/compare_noise_models.py --quick    simulated tracks with known gamma; exit code 1 out of the bands

Density: ln p of the held-out image point (px), given the other observations of its track, nats per observation. Tracks
are split in two halves; everything that is fitted (gamma, nu0, s0 per model; f, sigma or theta per image) is fitted on
one half and judged on the other, both ways. All models are judged on the same observations. The densities contain
ln det (I - H) / 2 - 2 ln w, so that they are densities of the same thing, the image point, under every weighting.
Column gain is the density minus track's, with a standard error clustered by track. ks, ks_fit: share of images
rejected at 5 %; kurt: median excess kurtosis over images; z of all observations, as the audit would have it. None of
the columns says that a camera is right.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.inliers.distortion import DistortionDerivatives
from sfm_audit.audit.inliers.residuals import ModelResiduals, model_residuals
from sfm_audit.audit.noise.fits import fit_constant_variance, fit_variance
from sfm_audit.audit.noise.keypoint import KeypointTracks, keypoint_noise, keypoint_tracks, scale_only_noise
from sfm_audit.audit.noise.others import ByRow
from sfm_audit.audit.noise.predictive import TrackStandardiser, predict
from sfm_audit.audit.noise.prior import fit_track_prior
from sfm_audit.audit.noise.standardise import ImageNoise, ModelTracks, model_tracks, track_noise
from sfm_audit.audit.noise.tracks import TrackStatistics, track_statistics
from sfm_audit.audit.normality import normality_tests
from sfm_audit.loaders import open_model
from sfm_audit.loaders.arrays import BoolArray, FloatArray
from sfm_audit.loaders.colmap.database import find_database, read_keypoint_shapes
from sfm_audit.loaders.datasets.discover import discover

NAMES: Final = ("constant", "scale alone", "track", "track and scale")
CONFIG: Final = AuditConfig()
MIN_OBSERVATIONS: Final = 20
HEADER: Final = (
    f"{'model':40s} {'noise':16s} {'density':>8s} {'gain':>15s} {'ks':>5s} {'ks_fit':>6s} {'kurt':>6s}  gamma"
)


def plain_tracks(residuals: ModelResiduals, num_points: int) -> ModelTracks:
    """Whiten as the audit does by default."""
    return model_tracks(
        residuals,
        num_points,
        pose_offset_threshold_px=CONFIG.pose_offset_threshold_px,
        min_track_length=CONFIG.min_track_length,
        min_eigenvalue=CONFIG.min_track_eigenvalue,
    )


def weighted_tracks(residuals: ModelResiduals, num_points: int, scale_px: FloatArray) -> KeypointTracks:
    """Whiten with weights as the audit does by default."""
    return keypoint_tracks(
        residuals,
        num_points,
        scale_px,
        pose_offset_threshold_px=CONFIG.pose_offset_threshold_px,
        min_track_length=CONFIG.min_track_length,
        min_eigenvalue=CONFIG.min_track_eigenvalue,
    )


def half_log_det_complement(jacobian: FloatArray, point_idx: np.ndarray, num_points: int) -> FloatArray:
    """Return (n,) ln det(I - H) / 2, H of method.md (2), for Jacobians (2, 3, n)."""
    rows = jacobian.transpose(2, 0, 1)
    information = np.zeros((num_points, 3, 3))
    np.add.at(information, point_idx, rows.transpose(0, 2, 1) @ rows)
    scale = np.sqrt(np.einsum("pii->pi", information))
    scale[scale == 0] = 1.0
    inverse = np.linalg.pinv(information / (scale[:, :, None] * scale[:, None, :]), rcond=1e-10, hermitian=True)
    inverse /= scale[:, :, None] * scale[:, None, :]
    complement = np.eye(2) - rows @ inverse[point_idx] @ rows.transpose(0, 2, 1)
    return np.asarray(0.5 * np.log(np.maximum(np.linalg.det(complement), np.finfo(np.float64).tiny)))


class HeldOut:
    """Densities of one model's observations; ``fitted`` (n,) marks the half on which everything is fitted."""

    def __init__(self, residuals: ModelResiduals, num_points: int, scale_px: FloatArray, fitted: BoolArray) -> None:
        self.residuals, self.num_points, self.fitted = residuals, num_points, fitted
        self.scale_px = scale_px
        self.image_idx = np.repeat(np.arange(len(residuals.offsets) - 1), np.diff(residuals.offsets))
        unknown = np.full(len(scale_px), np.nan)
        unknown[residuals.observation_row[fitted]] = scale_px[residuals.observation_row[fitted]]
        keypoints = weighted_tracks(residuals, num_points, unknown)
        self.gamma = keypoints.power.gamma
        relative = scale_px[residuals.observation_row] / keypoints.median_scale_px
        self.plain = self._statistics(np.ones_like(relative))
        self.weight = relative**self.gamma
        self.weighted = self._statistics(self.weight)
        self.verified = self.plain.verified & self.weighted.verified

    def _statistics(self, weight: FloatArray) -> TrackStatistics:
        r = self.residuals
        return track_statistics(r.residuals_px / weight, r.point_jacobian / weight, r.point_idx, self.num_points)

    def densities(self) -> dict[str, FloatArray]:
        """Return (n,) nats by noise model, NaN where not judged."""
        r, ones = self.residuals, np.ones_like(self.weight)
        volume = half_log_det_complement(r.point_jacobian, r.point_idx, self.num_points)
        weighted_volume = half_log_det_complement(r.point_jacobian / self.weight, r.point_idx, self.num_points)
        a = self.scale_px[r.observation_row]
        return {
            NAMES[0]: self._gaussian(np.zeros_like(a)) + volume,
            NAMES[1]: self._gaussian(a**2) + volume,
            NAMES[2]: self._student(self.plain, ones) + volume,
            NAMES[3]: self._student(self.weighted, self.weight) + weighted_volume,
        }

    def _halves(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows of each image to fit on and to judge; images with too few to fit on are left out."""
        halves = []
        for image in range(len(self.residuals.offsets) - 1):
            own = self.verified & (self.image_idx == image)
            pair = np.flatnonzero(own & self.fitted), np.flatnonzero(own & ~self.fitted)
            if len(pair[0]) >= MIN_OBSERVATIONS:
                halves.append(pair)
        return halves

    def _gaussian(self, predictor: FloatArray) -> FloatArray:
        out = np.full(len(predictor), np.nan)
        sq = self.plain.whitened_px**2
        for train, test in self._halves():
            if predictor.any():
                fit = fit_variance(sq[:, train].ravel(), np.tile(predictor[train], 2))
            else:
                fit = fit_constant_variance(sq[:, train])
            variance = fit.detector_px2 + fit.structure * predictor[test]
            out[test] = -np.log(2 * np.pi * variance) - 0.5 * sq[:, test].sum(axis=0) / variance
        return out

    def _student(self, statistics: TrackStatistics, weight: FloatArray) -> FloatArray:
        out = np.full(len(weight), np.nan)
        q, c, dof = (statistics.whitened_px**2).sum(axis=0), statistics.other_sq_px2, statistics.other_dof
        steady = ~(self.residuals.pose_offset_px > CONFIG.pose_offset_threshold_px)
        train_all = np.flatnonzero(self.verified & self.fitted & steady[self.image_idx])
        prior = fit_track_prior(q[train_all], c[train_all], dof[train_all])
        for train, test in self._halves():
            standardiser = TrackStandardiser.build(predict(prior, ByRow(c[train], dof[train], dof[train]), len(train)))
            factor = standardiser.standardise(statistics.whitened_px[:, train], slice(0, len(train))).factor
            nu, b = prior.nu0 + dof[test], prior.nu0 * prior.s0_px**2 + c[test]
            spread = np.log(2 * np.pi * factor**2 * b / nu) + (0.5 * nu + 1) * np.log1p(q[test] / (factor**2 * b))
            out[test] = -spread - 2 * np.log(weight[test])
        return out


def densities(residuals: ModelResiduals, num_points: int, scale_px: FloatArray) -> dict[str, FloatArray]:
    """Return (n,) held-out densities by noise model, each half judged by fits to the other one."""
    odd = residuals.point_idx % 2 == 1
    both = [HeldOut(residuals, num_points, scale_px, fitted).densities() for fitted in (odd, ~odd)]
    merged = {name: np.where(odd, both[1][name], both[0][name]) for name in NAMES}
    judged = np.logical_and.reduce([np.isfinite(values) for values in merged.values()])
    return {name: np.where(judged, values, np.nan) for name, values in merged.items()}


def mean_and_error(values: FloatArray, track: np.ndarray) -> tuple[float, float]:
    """Mean of the finite values and its standard error, clustered by track."""
    finite = np.isfinite(values)
    mean = values[finite].mean()
    by_track = np.bincount(track[finite], weights=values[finite] - mean)
    return float(mean), float(np.sqrt((by_track**2).sum()) / np.count_nonzero(finite))


def fit_of(noises: list[ImageNoise]) -> str:
    """Return the shares of images rejected and the median excess kurtosis."""
    tests = [normality_tests(noise.z) for noise in noises]
    ks, fitted = (np.mean([getattr(t, name) < 0.05 for t in tests]) for name in ("ks_p", "ks_fitted_p"))
    return f"{ks:5.0%} {fitted:6.0%} {np.median([t.kurtosis_excess for t in tests]):6.2f}"


def image_noises(plain: ModelTracks, keypoints: KeypointTracks) -> dict[str, list[ImageNoise]]:
    """Standardise every image with enough verified observations under every noise model, as the audit does."""
    found: dict[str, list[ImageNoise]] = {name: [] for name in NAMES}
    for image in range(len(plain.offsets) - 1):
        rows = slice(int(plain.offsets[image]), int(plain.offsets[image + 1]))
        verified = plain.statistics.verified[rows]
        if np.count_nonzero(verified) < MIN_OBSERVATIONS:
            continue
        whitened = plain.statistics.whitened_px[:, rows][:, verified]
        known = slice(int(keypoints.tracks.offsets[image]), int(keypoints.tracks.offsets[image + 1]))
        scale = keypoints.scale_px[known]
        found[NAMES[0]].append(scale_only_noise(whitened, np.zeros(whitened.shape[1]), np.nan))
        found[NAMES[1]].append(scale_only_noise(whitened, scale[verified], np.nan))
        found[NAMES[2]].append(track_noise(plain, image, np.nan))
        found[NAMES[3]].append(keypoint_noise(keypoints, plain, image, np.nan))
    return found


def compare(label: str, residuals: ModelResiduals, num_points: int, scale_px: FloatArray) -> float:
    """Print the lines of one model and return the gain of both predictors over the track alone, nats; NaN if none."""
    plain = plain_tracks(residuals, num_points)
    if np.count_nonzero(plain.statistics.verified) < 2 * MIN_OBSERVATIONS:
        print(f"{label:40s} too few verified observations: {np.count_nonzero(plain.statistics.verified)}")
        return float("nan")
    keypoints = weighted_tracks(residuals, num_points, scale_px)
    found = densities(residuals, num_points, scale_px)
    noises = image_noises(plain, keypoints)
    for name in NAMES:
        gain, error = mean_and_error(found[name] - found[NAMES[2]], residuals.point_idx)
        power = keypoints.power
        tail = f"{power.gamma:.2f} (ln L + {power.log_likelihood_gain:.1f})" if name == NAMES[3] else ""
        density = np.nanmean(found[name])
        print(f"{label:40s} {name:16s} {density:8.4f} {gain:7.4f}+-{error:.4f} {fit_of(noises[name])}  {tail}")
    return mean_and_error(found[NAMES[3]] - found[NAMES[2]], residuals.point_idx)[0]


def compare_folder(folder: Path) -> None:
    """Compare the noise models on every model below ``folder`` that has a database."""
    for ref in discover([folder]).refs:
        database = find_database(ref.location)
        if database is None:
            print(f"{ref.scene}/{ref.component}: no database.db beside it or above", file=sys.stderr)
            continue
        model = open_model(ref.location)
        scale_px = read_keypoint_shapes(database, model).scale_px
        compare(f"{ref.scene}/{ref.component}", model_residuals(model), len(model.points), scale_px)


def simulated(gamma: float, rng: np.random.Generator) -> tuple[ModelResiduals, int, FloatArray]:
    """Draw tracks of 6 images with t-distributed variances and noise that grows as scale^gamma, points at optimum."""
    num_images, num_points = 6, 1500
    n = num_images * num_points
    point_idx = np.tile(np.arange(num_points, dtype=np.int32), num_images)
    scale_px = np.exp(rng.normal(0.5, 0.5, n))
    sd = 0.3 * np.sqrt(4.0 / rng.chisquare(4.0, num_points))[point_idx] * (scale_px / np.exp(0.5)) ** gamma
    jacobian = rng.normal(size=(2, 3, n)) * 100.0
    noise = rng.normal(size=(2, n)) * sd
    empty = np.zeros(num_images, dtype=np.int64)
    offsets = np.arange(num_images + 1) * num_points
    residuals = ModelResiduals(
        offsets,
        np.arange(n, dtype=np.int32),
        point_idx,
        noise,
        jacobian,
        np.zeros(num_images),
        DistortionDerivatives({}),
        empty,
        empty,
        empty,
        empty,
    )
    rows = jacobian.transpose(2, 0, 1)
    information, gradient = np.zeros((num_points, 3, 3)), np.zeros((num_points, 3))
    np.add.at(information, point_idx, rows.transpose(0, 2, 1) @ rows)
    np.add.at(gradient, point_idx, np.einsum("nai,an->ni", rows, noise))
    moved = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
    fitted = noise - np.einsum("nai,ni->an", rows, moved[point_idx])
    return replace(residuals, residuals_px=fitted), num_points, scale_px


def quick() -> bool:
    """Compare on simulated tracks; whether gamma and the gains are in their bands."""
    fine = True
    for gamma in (0.0, 0.5):
        residuals, num_points, scale_px = simulated(gamma, np.random.default_rng(7))
        gain = compare(f"simulated, gamma = {gamma}", residuals, num_points, scale_px)
        found = weighted_tracks(residuals, num_points, scale_px).power.gamma
        band = gain > 0.05 if gamma else abs(gain) < 0.002
        fine = fine and abs(found - gamma) < 0.05 and band
    return fine


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="folder with COLMAP models and their database.db")
    parser.add_argument("--quick", action="store_true", help="simulated tracks with known gamma, about 5 seconds")
    args = parser.parse_args()
    if args.folder is None and not args.quick:
        parser.error("name a folder, or --quick")
    print(HEADER)
    if args.folder is not None:
        compare_folder(args.folder)
    return 0 if not args.quick or quick() else 1


if __name__ == "__main__":
    sys.exit(main())
