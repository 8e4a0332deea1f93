"""What is extreme and allowed: scales, offsets, sizes and numbers of things, each in a process of its own.

    scripts/stress.py              all of it, the full size
    scripts/stress.py --quick      small, three minutes; exit code 1 where a limit is exceeded
    scripts/stress.py --only scales --only images

docs/reliability.md holds measured numbers. Memory is the peak over what the imports took (VmHWM), time is CPU time.
"""

from __future__ import annotations

import argparse
import importlib
import json
import re
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
writer: Any = importlib.import_module("model_writer")

_SCALES: Final = (1e-12, 1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9)
_MAX_RATIO: Final = 8.0
_MAX_RATIO_QUICK: Final = 10.0  # what does not grow with the file counts in a file of 21 MB
_SAME: Final = 1e-5  # relative, of lengths in px
_FOCAL_PX: Final = 800.0
_CENTRE_PX: Final = 500.0


@dataclass(frozen=True, slots=True)
class Measured:
    """One stress: what was measured, in words, and what it exceeds, if anything."""

    text: str
    exceeds: str = ""


def main(args: Sequence[str] | None = None) -> int:
    """Measure, print; return 1 where a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", action="append", choices=list(_STRESSES), help="repeatable; default: all")
    parser.add_argument("--here", choices=list(_STRESSES), help=argparse.SUPPRESS)  # the process of one stress
    options = parser.parse_args(args)
    if options.here:
        with tempfile.TemporaryDirectory(prefix="stress-") as folder:
            measured = _STRESSES[options.here](Path(folder), options.quick)
        print(json.dumps([measured.text, measured.exceeds]))
        return 0
    has_failed = False
    for name in options.only or _STRESSES:
        command = [sys.executable, __file__, "--here", name, *(["--quick"] if options.quick else [])]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        measured = Measured(*json.loads(done.stdout.splitlines()[-1]))
        print(f"{name:10s} {measured.text}{f'; EXCEEDS {measured.exceeds}' if measured.exceeds else ''}", flush=True)
        has_failed |= bool(measured.exceeds)
    return int(has_failed)


def _audit(folder: Path) -> Any:
    """Audit a model in this process; Arrow tables."""
    from sfm_audit import open_model  # noqa: PLC0415 - in the process of one stress
    from sfm_audit.audit.engine.model import audit_model  # noqa: PLC0415

    return audit_model(open_model(folder))


def _verdicts(folder: Path, model: Any) -> tuple[list[Any], np.ndarray[Any, Any]]:
    """Return verdicts and lengths in px (3, images) of a model's images."""
    images = _audit(writer.write_binary(folder, model)).images
    words = [images[name].to_pylist() for name in images.column_names if name.startswith("verdict")]
    return words, np.array([images[name].to_numpy() for name in ("rms_px", "max_px", "sigma_constant_px")])


def _compare(folder: Path, models: Mapping[str, Any]) -> Measured:
    """Audit models that must be judged as the first one is."""
    (_, first), *others = models.items()
    words, lengths = _verdicts(folder / "first", first)
    worst, changed = 0.0, []
    for i, (name, model) in enumerate(others):
        found, px = _verdicts(folder / str(i), model)
        worst = max(worst, float(np.max(np.abs(px / lengths - 1.0))))
        changed += [name] if found != words else []
    text = f"{', '.join(name for name, _ in others)}: lengths in px differ by at most {worst:.1e}"
    exceeds = f"{_SAME:g}" * (worst > _SAME) + (f" other verdicts at {', '.join(changed)}" if changed else "")
    return Measured(text, exceeds)


def scales(folder: Path, _quick: bool) -> Measured:
    """The unit of the world: verdicts are the same from 1e-12 to 1e9."""
    model = writer.noisy_model(num_images=10, num_points=200)
    scaled = {f"{scale:g}": _moved(model, scale, 0.0) for scale in _SCALES}
    return _compare(folder, {"1": model, **scaled})


def offset(folder: Path, _quick: bool) -> Measured:
    """The origin of the world: 1e6 away from cameras and points, whose baseline is 0.3."""
    model = writer.noisy_model(num_images=10, num_points=200)
    return _compare(folder, {"0": model, "offset 1e6": _moved(model, 1.0, 1e6)})


def _moved(model: Any, scale: float, shift: float) -> Any:
    """Return the model (all rotations are the identity) in another unit, around another origin."""
    points = tuple(replace(each, xyz=tuple(scale * x + shift for x in each.xyz)) for each in model.points)
    poses = (tuple(scale * t - shift for t in each.pose[4:]) for each in model.images)
    images = tuple(replace(each, pose=(*each.pose[:4], *pose)) for each, pose in zip(model.images, poses, strict=True))
    return model.but(points=points, images=images)


def points(folder: Path, quick: bool) -> Measured:
    """One image with a million points, and a second one that sees them: memory beside the file."""
    num = 200_000 if quick else 1_000_000
    _written(folder, num_groups=1, num_points=num, track_length=2)
    size = _size(folder)
    before = _peak()
    _audit(folder)
    ratio, most = (_peak() - before) / size, _MAX_RATIO_QUICK if quick else _MAX_RATIO
    text = f"{num} points in each of 2 images, {size >> 20} MB: {ratio:.1f} times the file in memory"
    return Measured(text, f"{most:g} times" * (ratio > most))


def images(folder: Path, quick: bool) -> Measured:
    """A hundred thousand images with 5 points: what an image costs that cannot be tested."""
    num = 2_500 if quick else 100_000  # more than the pairs of all images are compared of
    _written(folder, num_groups=num // 5, num_points=5, track_length=5)
    _audit(writer.write_binary(folder / "warm", writer.noisy_model()))
    start, before = time.process_time(), _peak()
    audit = _audit(folder)
    milliseconds = 1e3 * (time.process_time() - start) / num
    grown = (_peak() - before) / num / 1024
    undetermined = sum(word == "undetermined" for word in audit.images["verdict"].to_pylist())
    text = f"{num} images with 5 points: {milliseconds:.2f} ms and {grown:.1f} kB each, {undetermined} undetermined"
    return Measured(text, "" if undetermined == num else "verdicts of 5 points")


def cameras(folder: Path, quick: bool) -> Measured:
    """65,000 cameras, of which ten have images."""
    num = 10_000 if quick else 65_000
    model = writer.noisy_model(num_images=10, num_points=200)
    more = (replace(model.cameras[0], camera_id=100 + i) for i in range(num))
    writer.write_binary(folder, model.but(cameras=(*model.cameras, *more)))
    start, before = time.process_time(), _peak()
    audit = _audit(folder)
    seconds, grown = time.process_time() - start, (_peak() - before) >> 20
    text = f"{num} cameras without images beside 2 with: {seconds:.1f} s, {grown} MB, {len(audit.cameras)} rows"
    return Measured(text, "30 s" * (seconds > 30.0))


def models(folder: Path, quick: bool) -> Measured:
    """2,000 models in one process: memory stays what it is."""
    num = 100 if quick else 2_000
    writer.write_binary(folder, writer.noisy_model())
    for _ in range(num // 4):
        _audit(folder)
    early = _resident()
    for _ in range(num - num // 4):
        _audit(folder)
    grown = (_resident() - early) / 2**20
    text = f"{num} models one after the other: {grown:+.1f} MB from a quarter of them to the end"
    return Measured(text, "8 MB" * (grown > 8.0))


def _written(folder: Path, **sizes: int) -> None:
    """Write in a process of its own, whose memory is not that of the audit."""
    with ProcessPoolExecutor(1) as pool:
        pool.submit(_write_views, folder, **sizes).result()


def _write_views(folder: Path, *, num_groups: int, num_points: int, track_length: int) -> None:
    """Write groups of ``track_length`` images that see the same points, without an object per point."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-1.0, -1.0, 5.0), (1.0, 1.0, 7.0), (num_groups, num_points, 3))
    camera = struct.pack("<QIiQQ4d", 1, 1, 2, 1000, 1000, _FOCAL_PX, _CENTRE_PX, _CENTRE_PX, 0.0)
    (folder / "cameras.bin").write_bytes(camera)
    records = np.empty(num_points, dtype=[("xy", "<f8", 2), ("id", "<u8")])
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", num_groups * track_length))
        for image in range(num_groups * track_length):
            group, place = divmod(image, track_length)
            centre = np.array([0.2 * place - 0.4, 0.05 * place, 0.0])
            seen = xyz[group] - centre
            records["xy"] = seen[:, :2] / seen[:, 2:] * _FOCAL_PX + _CENTRE_PX + rng.normal(0.0, 0.5, (num_points, 2))
            records["id"] = group * num_points + np.arange(num_points) + 1
            file.write(struct.pack("<I7dI", image + 1, 1, 0, 0, 0, *-centre, 1) + b"%d.jpg\0" % image)
            file.write(struct.pack("<Q", num_points) + records.tobytes())
    layout = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
    table = np.zeros(num_groups * num_points, dtype=[*layout, ("track", "<u4", (track_length, 2))])
    groups, rows = np.divmod(np.arange(len(table)), num_points)
    table["id"], table["xyz"] = np.arange(len(table)) + 1, xyz.reshape(-1, 3)
    table["error"], table["length"] = 0.5, track_length
    table["track"][:, :, 0] = groups[:, None] * track_length + np.arange(track_length) + 1
    table["track"][:, :, 1] = rows[:, None]
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(table)) + table.tobytes())


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*.bin"))


def _peak() -> int:
    """Bytes: the peak of this process; the imports are done first."""
    importlib.import_module("sfm_audit.audit.engine.model")
    return _status("VmHWM")


def _resident() -> int:
    return _status("VmRSS")


def _status(field: str) -> int:
    found = re.search(rf"{field}:\s*(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
    if found is None:
        raise RuntimeError(f"no {field}: this script needs Linux")
    return int(found[1]) * 1024


_STRESSES: Final[Mapping[str, Callable[[Path, bool], Measured]]] = {
    each.__name__: each for each in (scales, offset, points, images, cameras, models)
}

if __name__ == "__main__":
    sys.exit(main())
