"""``sfm-audit simulate``: correspondences with known truth, the paper's board and a stand-in for its room."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import click
import numpy as np

from sfm_audit.audit.calibrate.camera import CalibratedCamera
from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.extras import extra
from sfm_audit.audit.simulate.board import BoardSet, BoardSpec, iterate_boards
from sfm_audit.audit.simulate.room import ROOM_CAMERAS, RoomSet, RoomSpec, room_sets
from sfm_audit.loaders.arrays import UInt8Array
from sfm_audit.loaders.correspondences.records import Correspondences
from sfm_audit.reports.errors import OutputError
from sfm_audit.reports.run_folder.new_files import new_folder
from sfm_audit.reports.text.wording import counted

TRUTH_FILE: Final = "truth.json"
MARK: Final = "sfm-audit simulate"
COLUMNS: Final = ("x", "y", "X", "Y", "Z", "Xp", "Yp", "Zp", "Xt", "Yt", "Zt")
NUM_ROOMS: Final = 10

Simulated = tuple[BoardSet | RoomSet, UInt8Array | None]


@dataclass(frozen=True, slots=True)
class _Simulation:
    """What is simulated: the settings that make the truth, and the sets, each with its photograph if there is one."""

    settings: dict[str, Any]
    sets: Iterator[Simulated]


@click.command("simulate", short_help="Write 2D-3D correspondences with known truth.")
@click.argument("scene", metavar="SCENE", type=click.Choice(["board", "room"]))
@click.option("-o", "--out", metavar="FOLDER", type=click.Path(path_type=Path), required=True)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Another seed, other noise.")
@click.option("--sets", "num_sets", type=click.IntRange(min=1), help="How many: 56 boards, 10 rooms by default.")
@click.option("--points-only", is_flag=True, help="board: corners with Gaussian noise, nothing rendered.")
@click.option("--images", "with_images", is_flag=True, help="board: write the photographs too.")
@click.option("--camera", type=click.Choice(list(ROOM_CAMERAS)), help="room: which; plain by default.")
@click.option("--force", is_flag=True, help="Replace an earlier simulation in FOLDER.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def command(*, scene: str, out: Path, force: bool, quiet: bool, **options: Any) -> ExitCode:
    """Simulate SCENE, board or room, and write one table of correspondences per image, as calibrate reads them.

    board: a 15 x 15 checkerboard that comes closer, photographed and scanned from the same place. room: 24 annotated
    lidar points. FOLDER then holds set_000.csv, set_001.csv, ... and truth.json (docs/simulate.md).

    Exit codes: 0 fine; 2 wrong usage, or FOLDER is taken; 4 FOLDER could not be written.
    """
    simulation = (_board if scene == "board" else _room)(**options)
    _refuse_taken(out, force=force)
    truth = {"made_by": MARK, "scene": scene, **simulation.settings}
    try:
        with new_folder(out) as folder:
            rows = [_write(folder, i, made, options) for i, made in enumerate(simulation.sets)]
            content = {**truth, "sets": rows}
            (folder / TRUTH_FILE).write_text(json.dumps(content, indent=1), encoding="utf-8")
    except (OutputError, OSError) as error:
        problem = error if isinstance(error, OutputError) else OutputError(out, error.strerror or str(error))
        raise KnownError(str(problem), ExitCode.OUTPUT) from error
    if not quiet:
        click.echo(f"{out}: {counted(len(rows), 'set')} of {scene}, truth in {TRUTH_FILE}")
    return ExitCode.OK


def _board(*, seed: int, num_sets: int | None, points_only: bool, with_images: bool, camera: str | None) -> _Simulation:
    if camera is not None:
        raise click.UsageError("--camera belongs to room; a board is seen by the paper's camera.")
    if points_only and with_images:
        raise click.UsageError("--images and --points-only exclude each other.")
    spec = BoardSpec() if num_sets is None else BoardSpec(num_sets=num_sets)
    settings = {"seed": seed, "rendered": not points_only, "spec": asdict(spec)}
    if points_only:
        return _Simulation(settings, iterate_boards(spec, seed, rendered=False))
    with extra("calibrate"):
        from sfm_audit.audit.simulate.render import DetectorError  # noqa: PLC0415 - needs the extra
    return _Simulation(settings, _with_known_errors(iterate_boards(spec, seed, rendered=True), DetectorError))


def _with_known_errors(boards: Iterator[Simulated], refused: type[Exception]) -> Iterator[Simulated]:
    """Pass on simulated boards; a corner that is not found is the user's to know, and none is left out."""
    try:
        yield from boards
    except refused as error:
        advice = "choose another --seed, or --points-only"
        raise KnownError(f"the detector failed: {error}; {advice}", ExitCode.USAGE) from error


def _room(*, seed: int, num_sets: int | None, points_only: bool, with_images: bool, camera: str | None) -> _Simulation:
    if points_only or with_images:
        raise click.UsageError("--points-only and --images belong to board; a room is not rendered.")
    spec = RoomSpec() if camera is None else RoomSpec(camera)
    sets = room_sets(spec, seed, NUM_ROOMS if num_sets is None else num_sets)
    return _Simulation({"seed": seed, "rendered": False, "spec": asdict(spec)}, ((made, None) for made in sets))


def _write(folder: Path, i: int, made: Simulated, options: dict[str, Any]) -> dict[str, Any]:
    """Write one set and return its truth."""
    truth, photograph = made
    name = f"set_{i:03d}"
    (folder / f"{name}.csv").write_bytes(correspondences_csv(truth.correspondences))
    if photograph is not None and options["with_images"]:
        import cv2  # noqa: PLC0415 - there, or nothing would be rendered

        _, png = cv2.imencode(".png", photograph)
        (folder / f"{name}.png").write_bytes(png.tobytes())
    described: dict[str, Any] = {"file": f"{name}.csv", "camera": _described(truth.true_camera)}
    if isinstance(truth, BoardSet):
        described |= {"coverage": truth.coverage, "extent": truth.extent}
    names = ("rotation_cam_from_world", "translation_cam_from_world", "true_xy_px", "true_xyz_world")
    return described | {key: getattr(truth, key).tolist() for key in names}


def correspondences_csv(correspondences: Correspondences) -> bytes:
    """Return correspondences with neighbours as a table that `loaders` reads back to the last bit."""
    parts = (
        correspondences.xy_px,
        correspondences.xyz_world,
        correspondences.pan_xyz_world,
        correspondences.tilt_xyz_world,
    )
    table = np.column_stack([part for part in parts if part is not None])
    head = [f"# width={correspondences.width} height={correspondences.height}", ",".join(COLUMNS[: table.shape[1]])]
    rows = [",".join(map(repr, row)) for row in table.tolist()]
    return ("\n".join([*head, *rows]) + "\n").encode()


def _described(camera: CalibratedCamera) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        "distortion": camera.distortion.value,
        "focal_px": list(camera.focal_px),
        "principal_point_px": list(camera.principal_point_px),
        "coefficients": camera.coefficients.tolist(),
    }


def _refuse_taken(out: Path, *, force: bool) -> None:
    """Let nobody lose a folder that is not an earlier simulation, nor that without asking."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    try:
        mark = json.loads((out / TRUTH_FILE).read_bytes())["made_by"]
    except (OSError, ValueError, KeyError, TypeError):
        mark = None
    if mark != MARK:
        raise KnownError(f"{out}: is not an earlier simulation; choose a new folder with -o", ExitCode.USAGE)
    foreign = [path.name for path in out.iterdir() if not _is_ours(path.name)]
    if foreign:
        raise KnownError(f"{out}: holds {foreign[0]!r} too; choose a new folder with -o", ExitCode.USAGE)
    if not force:
        raise KnownError(f"{out}: holds a simulation; choose another -o, or replace it with --force", ExitCode.USAGE)


def _is_ours(name: str) -> bool:
    return name == TRUTH_FILE or (name.startswith("set_") and name.endswith((".csv", ".png")))
