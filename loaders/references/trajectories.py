"""Trajectories of TUM, KITTI and EuRoC: poses of a camera or body over time.

TUM (https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats): lines ``timestamp tx ty tz qx qy qz qw``, seconds
and metres, pose of the camera in the world; comments begin with ``#``. Images are called by their timestamps.
KITTI odometry (its devkit's readme.txt): a line of 12 numbers per frame, the 3 x 4 matrix that takes points of the left
camera to the world, row by row, metres; image 000050.png is frame 50.
EuRoC (state_groundtruth_estimate0/data.csv): ``timestamp [ns], p_RS_R, q_RS (w x y z), v, biases``, pose of the body
(the IMU) in the world, metres; images are called by their timestamps in ns. Where the camera sits on the body, T_BS in
``../cam0/sensor.yaml`` says.
evo reads all three, and is GPL and brings matplotlib, seaborn and rosbags; the formats are a few lines each.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.errors import MalformedFileError, MissingFileError, Position, TruncatedFileError
from sfm_audit.loaders.paths.files import exists, open_input, reading
from sfm_audit.loaders.paths.locations import InputPath
from sfm_audit.loaders.paths.text_lines import TextFile, parse_floats, read_text
from sfm_audit.loaders.references.poses import ADVICE, MAX_POSES, PoseList, check_rotations, rotations_of

TUM_VALUES: Final = 8
KITTI_VALUES: Final = 12
EUROC_VALUES: Final = (8, 17)  # poses alone, or with velocity and biases
_NS: Final = 1e-9
_MAX_SECONDS: Final = 1e12
_MAX_YAML: Final = 1 << 20
_MOUNT: Final = re.compile(rb"T_BS\s*:(?:[^\[]|\n)*?data\s*:\s*\[([^\]]*)\]")


def read_tum(path: InputPath) -> PoseList:
    """Read a TUM trajectory; LoadError where it is none."""
    lines, values = _rows(path, TUM_VALUES, None)
    rotation = rotations_of(path, values[:, [7, 4, 5, 6]], lines)
    return _timed(path, lines, values[:, 0], (rotation.transpose(0, 2, 1), values[:, 1:4]))


def read_kitti(path: InputPath) -> PoseList:
    """Read a KITTI trajectory; LoadError where it is none."""
    lines, values = _rows(path, KITTI_VALUES, None)
    world_from_cam = values.reshape(-1, 3, 4)
    rotation = check_rotations(path, world_from_cam[:, :, :3], lines).transpose(0, 2, 1)
    return PoseList(str(path), rotation, world_from_cam[:, :, 3].copy(), is_metric=True)


def read_euroc(path: InputPath) -> PoseList:
    """Read the ground truth of EuRoC, and where the camera sits on the body.

    Raises
    ------
    LoadError
        It is none, or ``../cam0/sensor.yaml`` is not there.
    """
    lines, values = _rows(path, EUROC_VALUES[1], b",", also=EUROC_VALUES[0])
    mount = _mount(path)
    world_from_body = rotations_of(path, values[:, 4:8], lines)
    centre = values[:, 1:4] + world_from_body @ mount[:3, 3]
    rotation = (world_from_body @ mount[:3, :3]).transpose(0, 2, 1)
    return _timed(path, lines, values[:, 0] * _NS, (rotation, centre))


def _rows(path: InputPath, num: int, comma: bytes | None, also: int | None = None) -> tuple[list[int], FloatArray]:
    """Return line numbers and (n, num) numbers of the records of a file, cut to the fewer where there may be fewer."""
    file = read_text(path, ADVICE)
    lines, rows = [], []
    for line, record in file.records():
        tokens = record.split(comma)
        if len(tokens) not in {num, also}:
            raise file.malformed(line, f"{num} numbers", f"{len(tokens)}")
        lines.append(line)
        rows.append(parse_floats(file, line, tokens, f"{len(tokens)} values")[: min(num, also or num)])
    if not rows:
        raise file.truncated("poses", "none")
    if len(rows) > MAX_POSES:
        raise file.malformed(lines[MAX_POSES], f"at most {MAX_POSES} poses", "more")
    _check_end(file)
    return lines, np.array(rows)


def _check_end(file: TextFile) -> None:
    """Raise where the last line has no end: its last number may be cut, and would still be a number."""
    if not file.is_terminated:
        wanted, got = "a line end after the last line", "none, so its last number may be cut"
        raise TruncatedFileError(str(file.path), Position("line", len(file.lines)), wanted, got, "copy it again")


def _timed(path: InputPath, lines: list[int], seconds: FloatArray, poses: tuple[FloatArray, FloatArray]) -> PoseList:
    """Return poses (rotation camera from world, centre) in the order of time."""
    wrong = np.flatnonzero(~(np.abs(seconds) < _MAX_SECONDS))
    if len(wrong):
        position = Position("line", lines[int(wrong[0])])
        raise MalformedFileError(str(path), position, "a timestamp", f"{seconds[wrong[0]]}", ADVICE)
    order = np.argsort(seconds, kind="stable")
    return PoseList(str(path), poses[0][order], poses[1][order], is_metric=True, seconds=seconds[order])


def sensor_file(path: Path) -> Path:
    """Return where EuRoC says how the left camera is mounted, for a file of ground truth."""
    return path.absolute().parent.parent / "cam0" / "sensor.yaml"


def _mount(path: InputPath) -> FloatArray:
    """Return T_BS, body from camera (4, 4), of the left camera beside the ground truth."""
    if not isinstance(path, Path):
        wanted = "EuRoC's ground truth on this machine, beside cam0/sensor.yaml"
        raise MissingFileError(str(path), None, wanted, "one in an object store", "copy the sequence")
    yaml = sensor_file(path)
    if not exists(yaml):
        wanted, advice = "cam0/sensor.yaml beside the folder of the ground truth", "it says where the camera sits"
        raise MissingFileError(str(path), None, wanted, "none", f"{advice}; or give a TUM trajectory of the camera")
    file, _ = open_input(yaml)
    with file, reading(yaml):
        found = _MOUNT.search(file.read(_MAX_YAML))
    tokens = found[1].replace(b",", b" ").split() if found else []
    if len(tokens) != 16:
        raise MalformedFileError(str(yaml), None, "T_BS with 16 numbers", f"{len(tokens)}", ADVICE)
    values = parse_floats(TextFile(yaml, [], None, is_terminated=True), 1, tokens, "T_BS").reshape(4, 4)
    mount = np.eye(4)
    mount[:3, :3] = check_rotations(yaml, values[None, :3, :3], [1])[0]
    mount[:3, 3] = values[:3, 3]
    if not np.isfinite(mount).all():
        raise MalformedFileError(str(yaml), None, "a finite T_BS", "one that is not", ADVICE)
    return mount
