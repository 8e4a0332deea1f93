"""Do the parts of a model belong together? What its images say, put into findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np

from sfm_audit.audit.consistency.cause import CAUSE_MEANINGS, Cause, Explanation
from sfm_audit.audit.consistency.image import (
    DEFAULT_LIMITS,
    ConsistencyLimits,
    ImageConsistency,
    LinkedPoints,
    consistency_of_linked,
)
from sfm_audit.audit.consistency.together import clear_images
from sfm_audit.audit.inliers.residuals import ModelResiduals, model_residuals
from sfm_audit.loaders.arrays import BoolArray
from sfm_audit.loaders.model import SparseModel

_MAX_NAMES: Final = 5


class ConsistencyCode(StrEnum):
    """What can be said of a whole model."""

    PARTS_DISAGREE = "parts_disagree"
    POINTS_BEHIND = "points_behind"
    IMAGES_DISAGREE = "images_disagree"
    PIXEL_CONVENTION = "pixel_convention"


@dataclass(frozen=True, slots=True)
class ConsistencyFinding:
    """A code, how many items it concerns, one line for people, and the cause where one is known."""

    code: ConsistencyCode
    count: int
    text: str
    cause: Cause | None


@dataclass(frozen=True, slots=True, eq=False)
class ModelConsistency:
    """What the images say together.

    images: in the order given; a cause that only all images together can have is taken back where they do not have it.
    inconsistent: (I,) those whose camera is rejected and that are left out of what is
    shared; unknown counts as no.    parts_disagree: no lens of this model is to be diagnosed.
    points_behind: all observations lie behind their cameras, so that the images are undetermined.
    """

    images: tuple[ImageConsistency, ...]
    findings: tuple[ConsistencyFinding, ...]
    inconsistent: BoolArray
    parts_disagree: bool
    points_behind: bool

    @property
    def half_pixel(self) -> bool:
        """Whether half a pixel lies between the 2D points and the cameras of most images."""
        return any(finding.code is ConsistencyCode.PIXEL_CONVENTION for finding in self.findings)


def consistency_of(
    model: SparseModel, residuals: ModelResiduals | None = None, limits: ConsistencyLimits = DEFAULT_LIMITS
) -> ModelConsistency:
    """Ask all images of a model, in file order, and the model; ``residuals`` of its inliers where they are at hand."""
    residuals = model_residuals(model) if residuals is None else residuals
    observations = model.observations
    images = clear_images(model, residuals, limits)
    for image_idx, found in enumerate(images):
        if found is not None:
            continue
        linked, rows = slice(*observations.offsets[image_idx : image_idx + 2]), residuals.rows(image_idx)
        points = LinkedPoints(
            model.image(image_idx),
            observations.xy_px[linked],
            model.points.xyz_world,
            observations.point_idx[linked],
            residuals.observation_row[rows] - linked.start,
            residuals.residuals_px[:, rows],
            int(residuals.num_behind[image_idx]),
            int(residuals.num_unprojected[image_idx]),
        )
        images[image_idx] = consistency_of_linked(points, limits)
    return model_consistency([image for image in images if image is not None], limits)


def model_consistency(
    images: Sequence[ImageConsistency], limits: ConsistencyLimits = DEFAULT_LIMITS
) -> ModelConsistency:
    """Put together what the images of one model say.

    Notes
    -----
    method.md section 12. `parts_disagree`: half of the images that could be judged are inconsistent, or fit only after
    their own pose's step (``moved``), or more than 20 % of the observations lie behind their cameras. All of them
    behind: `points_behind` instead. Fewer inconsistent images: `images_disagree`, by name.
    """
    inconsistent = np.array([image.inconsistent is True for image in images], dtype=np.bool_)
    num_judged = sum(image.inconsistent is not None for image in images)
    images = _without_lone_scales(images, num_judged)
    num_linked = sum(image.num_linked for image in images)
    num_behind = round(sum((1.0 - image.share_in_front) * image.num_linked for image in images if image.num_linked))
    suspects = [image for image in images if image.inconsistent or image.moved]
    all_behind = num_linked >= limits.min_observations and num_behind == num_linked
    too_many_behind = num_linked >= limits.min_observations and num_behind > limits.max_share_wrong * num_linked
    disagree = 2 * len(suspects) >= num_judged > 0 or too_many_behind
    findings = []
    if all_behind:
        findings.append(_points_behind(images, num_behind))
    elif disagree:
        findings.append(_parts_disagree(suspects, num_judged, num_behind, num_linked))
    else:
        findings += _images_disagree([image for image in images if image.inconsistent], num_judged)
    findings += _pixel_convention(images)
    return ModelConsistency(tuple(images), tuple(findings), inconsistent, disagree, all_behind)


def _without_lone_scales(images: Sequence[ImageConsistency], num_judged: int) -> list[ImageConsistency]:
    """Return the images, with a scale of the points kept as a cause only where over half of the judged images say so.

    In one image another scale of the points is a pose that moved along its translation.
    """
    says_scale = [image.explanation is not None and image.explanation.cause is Cause.POINT_SCALE for image in images]
    if 2 * sum(says_scale) > num_judged:
        return list(images)
    return [_with_pose_blamed(image) if lone else image for image, lone in zip(images, says_scale, strict=True)]


def _with_pose_blamed(image: ImageConsistency) -> ImageConsistency:
    cause = Cause.POSES if image.moved else Cause.POSES_OR_POINTS
    numbers = image.explanation.numbers if image.explanation else ""
    return replace(image, explanation=Explanation(cause, CAUSE_MEANINGS[cause], numbers))


def _points_behind(images: Sequence[ImageConsistency], num_behind: int) -> ConsistencyFinding:
    cause = _common_cause(images)
    words = "axes flipped or poses inverted?" if cause is Cause.POSES_OR_POINTS else CAUSE_MEANINGS[cause]
    text = f"all {num_behind} linked points lie behind their cameras: {words}"
    return ConsistencyFinding(ConsistencyCode.POINTS_BEHIND, num_behind, text, cause)


def _parts_disagree(
    suspects: Sequence[ImageConsistency], num_judged: int, num_behind: int, num_linked: int
) -> ConsistencyFinding:
    cause = _common_cause(suspects)
    words = CAUSE_MEANINGS[cause]
    if example := next((i.explanation for i in suspects if i.explanation and i.explanation.cause is cause), None):
        words = example.text
    camera_ids = {image.camera_id for image in suspects}
    where = f"camera {next(iter(camera_ids))}: " if len(camera_ids) == 1 else ""
    counts = [f"{len(suspects)} of {num_judged} images"] if suspects else []
    counts += [f"{num_behind} of {num_linked} linked points behind their cameras"] if num_behind else []
    text = f"{where}{words}; {', '.join(counts)}"
    return ConsistencyFinding(ConsistencyCode.PARTS_DISAGREE, len(suspects) or num_behind, text, cause)


def _images_disagree(images: Sequence[ImageConsistency], num_judged: int) -> list[ConsistencyFinding]:
    """One finding per cause, with the names of its images."""
    causes = dict.fromkeys(image.explanation.cause for image in images if image.explanation)
    findings = []
    for cause in causes:
        names = [image.image_name for image in images if image.explanation and image.explanation.cause is cause]
        more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
        text = f"{', '.join(names[:_MAX_NAMES])}{more} of {num_judged} images: {CAUSE_MEANINGS[cause]}"
        findings.append(ConsistencyFinding(ConsistencyCode.IMAGES_DISAGREE, len(names), text, cause))
    return findings


def _pixel_convention(images: Sequence[ImageConsistency]) -> list[ConsistencyFinding]:
    """All observations of over half of the images shifted by the same half pixel."""
    num_known = sum(image.affine is not None for image in images)
    for sign in (1, -1):
        count = sum(image.half_pixel == sign for image in images)
        if 2 * count > num_known:
            half = f"{0.5 * sign:+.1f}"
            text = f"all observations of {count} of {num_known} images are shifted by ({half}, {half}) px: "
            return [
                ConsistencyFinding(
                    ConsistencyCode.PIXEL_CONVENTION, count, f"{text}is the first pixel's centre at 0 or at 0.5?", None
                )
            ]
    return []


def _common_cause(images: Sequence[ImageConsistency]) -> Cause:
    """The cause of more than half of the images, else poses or points."""
    causes = Counter(image.explanation.cause for image in images if image.explanation)
    for cause, count in causes.most_common(1):
        if 2 * count > len(images):
            return cause
    return Cause.POSES_OR_POINTS
