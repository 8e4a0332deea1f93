"""What is simulated, and how often: the whole study, and the small version for CI."""

from __future__ import annotations

from scripts.validation.advice import advise_one, advise_shared
from scripts.validation.frozen import Frozen, audit_frozen
from scripts.validation.scenes import Design, audit_images, audit_shared_camera
from scripts.validation.singles import EXACT_DEFECTS, exact_trials, power_trials, size_trials
from scripts.validation.study import Task
from scripts.validation.truth import CAMERA_DEFECTS, NOISES, SIZES
from sfm_audit.audit.simulate.noise import NoiseKind
from sfm_audit.audit.simulate.scene import SceneSpec

BOUNDED_NOISES = (NoiseKind.GAUSSIAN, NoiseKind.PER_TRACK_LOGNORMAL)
SHARED_K2 = (0.005, 0.01, 0.02, 0.05)
POWER_SIZES = (100, 250, 1000)
_BATCH, _BATCHES = 250, 4
_SMALL = SceneSpec(num_images=20)
_SCENES_OF_SIZE = {25: 25, 50: 25, 100: 25, 250: 25, 600: 25, 2000: 12, 5000: 4}
_SCENES_OF_OTHER_NOISE = {25: 8, 50: 8, 100: 8, 250: 8, 600: 8, 2000: 4, 5000: 1}


def full_plan(seed: int, share: float = 1.0) -> list[Task]:
    """Everything; ``share`` of the images and scenes, at least one of each.

    Always in full: where a count of nought is the claim (a quarter wrong, moved poses, frozen parameters).
    """

    def some(count: int) -> int:
        return max(1, round(count * share))

    tasks = []
    for noise in NOISES:
        for n in SIZES:
            tasks += _singles(noise, n, _BATCH * some(_BATCHES), seed)
            counts = _SCENES_OF_SIZE if noise in BOUNDED_NOISES else _SCENES_OF_OTHER_NOISE
            tasks += _scenes(Design("size", 0, noise, n), some(counts[n]), seed)
        tasks += _scenes(Design("size, shared camera", 1, noise, 250, shared_k2=0.0), some(6), seed)
        tasks += _scenes(Design("none", 2, noise), some(8), seed)
        tasks += _scenes(Design("quarter", 3, noise, share=0.25), 12, seed)
        tasks += _scenes(Design("half", 4, noise, share=0.5), some(6), seed)
        tasks += _scenes(Design("quarter, 150 points", 5, noise, 150, share=0.25), some(4), seed)
        short = SceneSpec(max_track_length=4)
        tasks += _scenes(Design("quarter, short tracks", 6, noise, share=0.25, scene=short), some(4), seed)
        tasks += _scenes(Design("poses and corners", 7, noise, num_poses=4, num_corners=4), 6, seed)
        tasks += _shared(Design("shared", 8, noise, 150, shared_k2=0.0, scene=_SMALL), some(15), seed)
        tasks += [Task("frozen", audit_frozen, (case, noise, k, seed), 2.0) for case in Frozen for k in range(2)]
    for kind in CAMERA_DEFECTS:
        for n in POWER_SIZES:
            of_power = [(kind, n, 200 * k, 200 * k + 200, seed) for k in range(some(2))]
            tasks += [Task("power", power_trials, args, 2.5) for args in of_power]
    for kind in EXACT_DEFECTS:
        of_exact = [(kind, _BATCH * k, _BATCH * k + _BATCH, seed) for k in range(some(_BATCHES))]
        tasks += [Task("exact", exact_trials, args, 2.0) for args in of_exact]
    for k2 in SHARED_K2:
        tasks += _shared(Design("shared", 9, n=150, shared_k2=k2, scene=_SMALL), some(12), seed)
    return tasks + _advice(some(120), some(8), seed)


def quick_plan(seed: int) -> list[Task]:
    """A minute of it."""
    tasks = []
    for noise in NOISES:
        for n in (25, 50, 250):
            tasks += _singles(noise, n, 100, seed)
        tasks += _scenes(Design("quarter", 3, noise, 250, share=0.25), 1, seed)
    for noise in BOUNDED_NOISES:
        for n in (100, 600):
            tasks += _scenes(Design("size", 0, noise, n), 3, seed)
        tasks += _scenes(Design("poses and corners", 7, noise, 250, num_poses=4, num_corners=4), 1, seed)
        tasks += _shared(Design("shared", 8, noise, 150, shared_k2=0.0, scene=_SMALL), 4, seed)
    tasks += [Task("frozen", audit_frozen, (case, NoiseKind.GAUSSIAN, 0, seed), 2.0) for case in Frozen]
    tasks += [Task("power", power_trials, (kind, 250, 0, 40, seed), 0.5) for kind in CAMERA_DEFECTS]
    tasks += [Task("exact", exact_trials, (kind, 0, 100, seed), 1.0) for kind in EXACT_DEFECTS]
    tasks += _shared(Design("shared", 9, n=150, shared_k2=0.02, scene=_SMALL), 2, seed)
    return tasks + _advice(4, 1, seed)


def _singles(noise: NoiseKind, n: int, trials: int, seed: int) -> list[Task]:
    """Correct cameras, independent points."""
    starts = range(0, trials, _BATCH)
    cost = (0.005 + 5e-6 * n) * min(_BATCH, trials)
    return [Task("singles", size_trials, (noise, n, k, min(k + _BATCH, trials), seed), cost) for k in starts]


def _scenes(design: Design, count: int, seed: int) -> list[Task]:
    cost = 0.4 + design.n * 2.5e-3 + 4.0 * design.share
    return [Task("scenes", audit_images, (design, k, seed), cost) for k in range(count)]


def _shared(design: Design, count: int, seed: int) -> list[Task]:
    return [Task("cameras", audit_shared_camera, (design, k, seed), 0.4) for k in range(count)]


def _advice(count: int, count_shared: int, seed: int) -> list[Task]:
    """One defective image each, the six kinds in turn; and shared cameras."""
    one = Design("one image", 10, n=300, share=0.05, scene=_SMALL)
    tasks = [Task("advice", advise_one, (one, k, seed), 1.0) for k in range(count)]
    for k2 in (0.02, 0.05):
        shared = Design("shared camera", 11, n=150, shared_k2=k2, scene=_SMALL)
        tasks += [Task("advice", advise_shared, (shared, k, seed), 0.7) for k in range(count_shared)]
    return tasks
