"""Memory beside the size of the files, in a process of its own: at most 6 times for models (limit: + 300 MB)."""

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

MEASURE = """
import resource, sys
from pathlib import Path
from sfm_audit.loaders import open_model
files = [path for path in Path(sys.argv[1]).iterdir()]
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
model = open_model(sys.argv[1])
grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
print(len(model.observations), grown / sum(path.stat().st_size for path in files))
"""


def write_large(folder: Path, num_images: int, num_points2d: int, track_length: int) -> None:
    """A model in binary whose images link all of their 2D points, made without a Python object per point."""
    rng = np.random.default_rng(0)
    num_points = num_images * num_points2d // track_length
    point = np.tile(np.arange(num_points), track_length)
    xy = rng.uniform(0.0, 1000.0, (len(point), 2))
    camera = struct.pack("<QIiQQ4d", 1, 1, 2, 1000, 1000, 800.0, 500.0, 500.0, 0.0)
    (folder / "cameras.bin").write_bytes(camera)
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", num_images))
        for image in range(num_images):
            part = slice(image * num_points2d, (image + 1) * num_points2d)
            records = np.empty(num_points2d, dtype=[("xy", "<f8", 2), ("id", "<u8")])
            records["xy"], records["id"] = xy[part], point[part] + 1
            file.write(struct.pack("<I7dI", image + 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"%d.jpg\0" % image)
            file.write(struct.pack("<Q", num_points2d) + records.tobytes())
    layout = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
    points = np.zeros(num_points, dtype=[*layout, ("track", "<u4", (track_length, 2))])
    order = np.argsort(point, kind="stable").reshape(num_points, track_length)
    points["id"], points["xyz"] = np.arange(num_points) + 1, rng.uniform(4.0, 6.0, (num_points, 3))
    points["error"], points["length"] = 0.5, track_length
    points["track"][:, :, 0], points["track"][:, :, 1] = order // num_points2d + 1, order % num_points2d
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", num_points) + points.tobytes())


def write_as_text(folder: Path) -> None:
    """The same in text, by pycolmap."""
    import pycolmap  # noqa: PLC0415 - to write, not to read

    reconstruction = pycolmap.Reconstruction(str(folder))
    for path in folder.iterdir():
        path.unlink()
    reconstruction.write_text(str(folder))


@pytest.mark.parametrize(
    ("shape", "is_text", "most"),
    [((1, 600_000, 1), False, 4.0), ((100, 8_000, 4), False, 4.0), ((1, 200_000, 1), True, 6.0)],
    ids=["one image", "many images", "text"],
)
def test_a_model_takes_a_few_times_its_files(tmp_path: Path, shape, is_text: bool, most: float):
    write_large(tmp_path, *shape)
    if is_text:
        write_as_text(tmp_path)
    done = subprocess.run([sys.executable, "-c", MEASURE, tmp_path], check=True, capture_output=True, text=True)
    num_observations, ratio = done.stdout.split()
    assert int(num_observations) == shape[0] * shape[1]
    assert float(ratio) < most
