"""What changed between two runs? Images are compared by dataset, scene and name: components and ids are renumbered.

Nothing is computed that the tables do not hold: images are counted, medians taken, numbers compared.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Final

from sfm_audit.reports.compare.keys import ImageKey, Noted, Scope
from sfm_audit.reports.compare.motion import POSE_COLUMNS, Aligner, PoseChange, StoredPose, pose_changes
from sfm_audit.reports.run_folder.reader import Row, RunReader

IMAGE_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "image_name", "camera_id", "camera_model", "num_inliers"),
    *("sigma_constant_px", "misfit_px", "pose_offset_px", "verdict", "verdict_misfit", "verdict_pose", "reasons"),
    *("sd_rotation_deg", "sd_centre"),
    *POSE_COLUMNS,
)
MODEL_COLUMNS: Final = (
    *("dataset", "scene", "component", "model_path", "num_images", "noise_s0_px", "recomputed_point_error_px"),
)
CAMERA_COLUMNS: Final = (*("dataset", "scene", "component", "model_path", "camera_id", "misfit_px", "misfit_material"),)
_NEEDED: Final = frozenset({"dataset", "scene", "component", "model_path"})
REJECTED: Final = "rejected"
ACCEPTED: Final = "accepted"

_ModelKey = tuple[str, str, str, str]


class MissingColumnError(Exception):
    """A table lacks the columns that say what its rows are about."""


@dataclass(frozen=True, slots=True)
class Systematic:
    """Systematic error of an image, px, by source. found: only where the audit rejects it; seen: any, 0 for none."""

    found: tuple[float, ...]
    seen: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ImageState:
    """What one run says about one image; of an image in several models, the one where it has most inliers."""

    key: ImageKey
    model: _ModelKey
    num_inliers: int
    verdict: str
    reasons: tuple[str, ...]
    camera_model: str | None
    sigma_px: float | None
    noise_s0_px: float | None
    recomputed_error_px: float | None
    systematic: Systematic
    pose: StoredPose | None = None
    sd_rotation_deg: float | None = None
    sd_centre: float | None = None

    @property
    def codes(self) -> frozenset[str]:
        """The codes of its reasons."""
        return frozenset(reason.split(":", 1)[0] for reason in self.reasons)


@dataclass(frozen=True, slots=True, eq=False)
class RunSnapshot:
    """One run by image. models: the images of every model, none for a model without images."""

    images: Mapping[ImageKey, ImageState]
    models: Mapping[_ModelKey, frozenset[ImageKey]]

    @classmethod
    def read(cls, run: RunReader) -> RunSnapshot:
        """Read the tables of a run; parts may come in any order.

        Raises
        ------
        MissingColumnError
            Rows do not say which model they belong to.
        """
        models = {_model_key(row): row for row in run.rows("models", MODEL_COLUMNS)}
        cameras = {
            (*_model_key(row), row["camera_id"]): (row.get("misfit_px") or 0.0, bool(row.get("misfit_material")))
            for row in run.rows("cameras", CAMERA_COLUMNS)
        }
        images: dict[ImageKey, ImageState] = {}
        members: defaultdict[_ModelKey, set[ImageKey]] = defaultdict(set)
        for row in run.rows("images", IMAGE_COLUMNS):
            key = _model_key(row)
            camera = cameras.get((*key, row.get("camera_id")), (0.0, False))
            state = _image_state(row, key, models.get(key, {}), camera)
            members[key].add(state.key)
            if state.key not in images or _precedence(images[state.key]) < _precedence(state):
                images[state.key] = state
        return cls(images, {key: frozenset(members[key]) for key in models})

    @property
    def has_poses(self) -> bool:
        """Whether it holds the pose of an image; runs of older versions do not."""
        return any(state.pose is not None for state in self.images.values())

    @property
    def scenes(self) -> set[tuple[str, str]]:
        """Dataset and scene of every model."""
        return {(dataset, scene) for dataset, scene, *_ in self.models}


@dataclass(frozen=True, slots=True)
class ScopeNumbers:
    """Numbers of one scope in one run; an image counts once, a number of a model once per image.

    sigma_px: median of sigma_constant_px.    noise_s0_px, recomputed_error_px: medians of the models' numbers.
    rejected_by_reason: of the rejected images.    by_reason: of all, whatever the verdict.
    accepted: the images that were accepted. Neither counts as a difference: other fields show what changed.
    """

    num_images: int
    num_accepted: int
    num_rejected: int
    num_undetermined: int
    rejected_by_reason: Mapping[str, int]
    sigma_px: float | None
    noise_s0_px: float | None
    recomputed_error_px: float | None
    accepted: tuple[ImageState, ...] = field(default=(), compare=False)
    by_reason: Mapping[str, int] = field(default_factory=dict, compare=False)

    def share(self, count: int) -> float | None:
        """Return a count as a share of the images, None without images."""
        return count / self.num_images if self.num_images else None


@dataclass(frozen=True, slots=True, eq=False)
class ScopeChange:
    """What changed in one scope. Images are sorted, each with a remark for people.

    was_there: whether the baseline has the scope.    lost_models: its models none of whose images is left.
    grown_px: by how much a systematic error is larger, px, largest first.
    other_verdict: how many images have another verdict, newly rejected and fixed ones among them.
    poses: where the cameras are, model by model; empty where nobody aligned them.
    """

    scope: Scope
    was_there: bool
    before: ScopeNumbers
    after: ScopeNumbers
    num_common: int
    lost: Noted
    added: Noted
    newly_rejected: Noted
    fixed: Noted
    remodelled: Noted
    grown_px: tuple[tuple[ImageKey, float], ...]
    other_verdict: int
    lost_scenes: tuple[str, ...]
    added_scenes: tuple[str, ...]
    lost_models: tuple[str, ...]
    poses: tuple[PoseChange, ...] = ()

    @property
    def moved(self) -> Noted:
        """Images that are elsewhere after the alignment, sorted."""
        return tuple(sorted(image for change in self.poses for image in change.moved))

    @property
    def anything(self) -> bool:
        """Whether anything that a comparison shows is different."""
        lists = (self.lost, self.added, self.newly_rejected, self.fixed, self.remodelled, self.grown_px)
        others = (self.other_verdict, self.lost_scenes, self.added_scenes, self.lost_models, self.moved)
        return any(lists) or any(others) or self.before != self.after


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Two runs, scope by scope: all, datasets, scenes, each in order of their names."""

    before: RunSnapshot
    after: RunSnapshot
    changes: tuple[ScopeChange, ...]

    @property
    def whole(self) -> ScopeChange:
        """The scope that holds everything."""
        return self.changes[0]

    @property
    def nothing_in_common(self) -> bool:
        """Whether no image of the baseline is found again: most likely the PATHs have other base names."""
        return bool(self.before.images) and bool(self.after.images) and not self.whole.num_common


def compare(before: RunSnapshot, after: RunSnapshot, align: Aligner | None = None) -> Comparison:
    """Compare a run with a baseline; ``align``: aligns the poses of two models, None to leave poses alone."""
    poses = pose_changes(before.images, after.images, align) if align else ()
    scenes = sorted(before.scenes | after.scenes)
    datasets = sorted({dataset for dataset, _ in scenes})
    scopes = [Scope(), *(Scope(dataset) for dataset in datasets), *(Scope(*scene) for scene in scenes)]
    images = [_by_scope(run.images.values()) for run in (before, after)]
    changes = (_change(scope, before, after, *images) for scope in scopes)
    placed = (replace(each, poses=tuple(p for p in poses if _holds(each.scope, *p.images[0][:2]))) for each in changes)
    return Comparison(before, after, tuple(placed))


def scope_numbers(run: RunSnapshot) -> dict[Scope, ScopeNumbers]:
    """Return the numbers of every scope of one run."""
    by_scope = _by_scope(run.images.values())
    scopes = [Scope(), *(Scope(name) for name in sorted({d for d, _ in run.scenes}))]
    scopes += [Scope(*scene) for scene in sorted(run.scenes)]
    return {scope: _numbers(by_scope.get(scope, [])) for scope in scopes}


def _by_scope(states: Iterable[ImageState]) -> dict[Scope, list[ImageState]]:
    found: defaultdict[Scope, list[ImageState]] = defaultdict(list)
    for state in states:
        dataset, scene, _ = state.key
        for scope in (Scope(), Scope(dataset), Scope(dataset, scene)):
            found[scope].append(state)
    return found


def _change(
    scope: Scope,
    before: RunSnapshot,
    after: RunSnapshot,
    before_states: Mapping[Scope, list[ImageState]],
    after_states: Mapping[Scope, list[ImageState]],
) -> ScopeChange:
    old = {state.key: state for state in before_states.get(scope, [])}
    new = {state.key: state for state in after_states.get(scope, [])}
    common = sorted(old.keys() & new.keys())
    grown = ((key, growth) for key in common if (growth := _growth_px(old[key], new[key])) > 0)

    def changed(is_wanted: Callable[[ImageState, ImageState], bool], note: Callable[[ImageKey], str]) -> Noted:
        return tuple((key, note(key)) for key in common if is_wanted(old[key], new[key]))

    return ScopeChange(
        scope,
        any(_holds(scope, *scene) for scene in before.scenes),
        _numbers(old.values()),
        _numbers(new.values()),
        len(common),
        lost=tuple((key, f"was {old[key].verdict}") for key in sorted(old.keys() - new.keys())),
        added=tuple((key, f"is {new[key].verdict}") for key in sorted(new.keys() - old.keys())),
        newly_rejected=changed(lambda a, b: a.verdict != REJECTED == b.verdict, lambda k: "; ".join(new[k].reasons)),
        fixed=changed(lambda a, b: a.verdict == REJECTED != b.verdict, lambda k: f"is {new[k].verdict}"),
        remodelled=changed(
            lambda a, b: a.camera_model != b.camera_model, lambda k: f"{old[k].camera_model} -> {new[k].camera_model}"
        ),
        grown_px=tuple(sorted(grown, key=lambda item: (-item[1], item[0]))),
        other_verdict=sum(old[key].verdict != new[key].verdict for key in common),
        lost_scenes=_scene_names(scope, before.scenes - after.scenes),
        added_scenes=_scene_names(scope, after.scenes - before.scenes),
        lost_models=_lost_models(scope, before, after),
    )


def _numbers(states: Iterable[ImageState]) -> ScopeNumbers:
    listed = list(states)
    verdicts = Counter(state.verdict for state in listed)
    codes = Counter(code for state in listed if state.verdict == REJECTED for code in state.codes)
    return ScopeNumbers(
        len(listed),
        verdicts[ACCEPTED],
        verdicts[REJECTED],
        len(listed) - verdicts[ACCEPTED] - verdicts[REJECTED],
        dict(sorted(codes.items())),
        _median(state.sigma_px for state in listed),
        _median(state.noise_s0_px for state in listed),
        _median(state.recomputed_error_px for state in listed),
        tuple(state for state in listed if state.verdict == ACCEPTED),
        Counter(code for state in listed for code in state.codes),
    )


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def _growth_px(old: ImageState, new: ImageState) -> float:
    """By how much a systematic error that is found now exceeds what was seen before, found or not."""
    pairs = zip(new.systematic.found, old.systematic.seen, strict=True)
    return max(found - seen for found, seen in pairs)


def _scene_names(scope: Scope, scenes: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    return tuple(f"{dataset}/{scene}" for dataset, scene in sorted(scenes) if _holds(scope, dataset, scene))


def _holds(scope: Scope, dataset: str, scene: str) -> bool:
    return scope.dataset in {None, dataset} and scope.scene in {None, scene}


def _lost_models(scope: Scope, before: RunSnapshot, after: RunSnapshot) -> tuple[str, ...]:
    return tuple(
        "/".join(key[:3])
        for key, images in sorted(before.models.items())
        if images and _holds(scope, *key[:2]) and images.isdisjoint(after.images)
    )


def _model_key(row: Row) -> _ModelKey:
    missing = sorted(_NEEDED - row.keys())
    if missing:
        raise MissingColumnError(f"a table has no column {missing[0]}")
    return row["dataset"], row["scene"], row["component"], row["model_path"]


def _image_state(row: Row, model_key: _ModelKey, model: Row, camera: tuple[float, bool]) -> ImageState:
    if not {"image_name", "verdict"} <= row.keys():
        raise MissingColumnError("the images table has no column image_name or verdict")
    misfit, pose = row.get("misfit_px") or 0.0, row.get("pose_offset_px") or 0.0
    is_misfit, is_moved = row.get("verdict_misfit") == REJECTED, row.get("verdict_pose") == REJECTED
    of_camera, is_material = camera
    return ImageState(
        ImageKey(row["dataset"], row["scene"], row["image_name"]),
        model_key,
        row.get("num_inliers") or 0,
        row["verdict"],
        tuple(row.get("reasons") or ()),
        row.get("camera_model"),
        row.get("sigma_constant_px"),
        model.get("noise_s0_px"),
        model.get("recomputed_point_error_px"),
        Systematic(
            found=(misfit * is_misfit, pose * is_moved, of_camera * is_material), seen=(misfit, pose, of_camera)
        ),
        StoredPose.of(row),
        row.get("sd_rotation_deg"),
        row.get("sd_centre"),
    )


def _precedence(state: ImageState) -> tuple[int, _ModelKey, str, tuple[str, ...]]:
    """Of the same image in several models, take the one with most inliers; the rest only makes it unambiguous."""
    return state.num_inliers, state.model, state.verdict, state.reasons
