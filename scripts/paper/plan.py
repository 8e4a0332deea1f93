"""What is simulated, and how often: everything, and the small version for CI."""

from __future__ import annotations

from scripts.paper.board_study import POINTS, RENDERED, BoardDesign, board_rows, protection_rows
from scripts.paper.megadepth import megadepth_folder, megadepth_images, model_locations
from scripts.paper.motivating import SIGMAS, SIZES, motivating_trials
from scripts.paper.tables import CAMERAS, room_rows, zhang_rows
from scripts.validation.study import Task
from sfm_audit.audit.simulate.board import BoardSpec

BOARD_SEEDS = 8
_QUICK_SCENE = "9003"
_ROOMS_PER_TASK = 25


def full_plan(seed: int, board_seeds: int = BOARD_SEEDS, *, points_only: bool = False) -> list[Task]:
    """Everything; with ``points_only`` no photograph is rendered."""
    sources = [BoardDesign(POINTS)] if points_only else [BoardDesign(RENDERED), BoardDesign(POINTS)]
    tasks = [
        Task("boards", board_rows, (design, seed + k), 30.0 if design.source == RENDERED else 12.0)
        for k in range(board_seeds)
        for design in sources
    ]
    tasks += [
        Task("protection", protection_rows, (BoardDesign(POINTS), seed + k), 15.0) for k in range(board_seeds // 2)
    ]
    tasks += _motivating(200, seed) + _tables(100, 20, seed)
    folder = megadepth_folder()
    models = model_locations(folder) if folder else []
    return tasks + [Task("megadepth", megadepth_images, model, 8.0) for model in models]


def quick_plan(seed: int) -> list[Task]:
    """A minute of it: all sets once from points, a quarter of them rendered."""
    few = BoardDesign(RENDERED, BoardSpec(num_sets=15))
    tasks = [
        Task("boards", board_rows, (BoardDesign(POINTS), seed), 12.0),
        Task("boards", board_rows, (few, seed), 8.0),
    ]
    tasks += _motivating(20, seed) + _tables(10, 2, seed)
    folder = megadepth_folder()
    models = [model for model in model_locations(folder) if model[0] == _QUICK_SCENE] if folder else []
    return tasks + [Task("megadepth", megadepth_images, model, 8.0) for model in models]


def _motivating(trials: int, seed: int) -> list[Task]:
    return [
        Task("motivating", motivating_trials, (n, sigma, trials, seed), 1e-5 * n * trials)
        for n in SIZES
        for sigma in SIGMAS
    ]


def _tables(rooms: int, runs: int, seed: int) -> list[Task]:
    tasks = [Task("zhang", zhang_rows, (camera, seed + k), 2.0) for camera in CAMERAS for k in range(runs)]
    for camera in CAMERAS:
        starts = range(0, rooms, _ROOMS_PER_TASK)
        tasks += [Task("rooms", room_rows, (camera, k, min(k + _ROOMS_PER_TASK, rooms), seed), 8.0) for k in starts]
    return tasks
