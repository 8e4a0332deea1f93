"""Memory beside the size of the files, in a process of its own: at most 6 times for models (limit: + 300 MB)."""

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

PEAK = """
import re, resource, sys
from pathlib import Path

def peak():
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss is at least that of the process which started this one
        return int(re.search(r"VmHWM:\\s*(\\d+) kB", status.read_text())[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
"""
MEASURE = """
from sfm_audit.loaders import open_model
files = [path for path in Path(sys.argv[1]).iterdir()]
before = peak()
model = open_model(sys.argv[1])
grown = peak() - before
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
    done = subprocess.run([sys.executable, "-c", PEAK + MEASURE, tmp_path], check=True, capture_output=True, text=True)
    num_observations, ratio = done.stdout.split()
    assert int(num_observations) == shape[0] * shape[1]
    assert float(ratio) < most


TABLE = "from sfm_audit.loaders.correspondences.table import read_correspondences as read"
OTHERS = {
    "csv": TABLE,
    "parquet": f"{TABLE}\nimport pyarrow.parquet",
    "ptx": "from sfm_audit.loaders.correspondences.scan_ptx import read_ptx as read",
    "npz": "from sfm_audit.loaders.scene_info.file import read_scene_info as read",
    "pickle": "from sfm_audit.loaders.scene_info.file import read_scene_info as read",
}
MEASURE_OTHERS = """
before = peak()
read(sys.argv[1])
print((peak() - before) / Path(sys.argv[1]).stat().st_size)
"""
WRITE = """
import pickle, sys
import numpy as np
kind, path = sys.argv[1:]
rng = np.random.default_rng(0)
names = ("x", "y", "X", "Y", "Z")
if kind == "csv":
    rows = rng.uniform(0.0, 1000.0, (100_000, 5))
    header = "# width=1000 height=1000\\n" + ",".join(names)
    np.savetxt(path, rows, fmt="%.6f", delimiter=",", header=header, comments="")
if kind == "parquet":
    import pyarrow as pa, pyarrow.parquet as pq
    table = pa.table({name: rng.uniform(0.0, 1000.0, 1_000_000) for name in names})
    pq.write_table(table.replace_schema_metadata({"width": "1000", "height": "1000"}), path)
if kind == "ptx":
    with open(path, "w") as file:
        file.write("750\\n400\\n0 0 0\\n1 0 0\\n0 1 0\\n0 0 1\\n1 0 0 0\\n0 1 0 0\\n0 0 1 0\\n5 6 7 1\\n")
        np.savetxt(file, rng.uniform(0.0, 100.0, (300_000, 4)), fmt="%.5f")
if kind in ("npz", "pickle"):
    num = 1200 if kind == "npz" else 100
    paths = np.array([f"a/{i}.jpg" for i in range(num)], dtype=object)
    info = dict(image_paths=paths, depth_paths=paths, intrinsics=np.zeros((num, 3, 3)), poses=np.zeros((num, 4, 4)))
    if kind == "npz":
        with open(path, "wb") as file:
            np.savez(file, **info, overlap_matrix=rng.random((num, num)), scale_ratio_matrix=rng.random((num, num)))
    else:
        pairs = np.empty(20_000, dtype=object)
        pairs[:] = [(np.array([i % num, i * 7 % num]), 0.5, rng.random((10, 4), np.float32)) for i in range(len(pairs))]
        with open(path, "wb") as file:
            pickle.dump({**info, "pair_infos": pairs}, file, protocol=4)
"""


@pytest.mark.parametrize(
    ("kind", "most"), [("csv", 3.0), ("parquet", 4.5), ("ptx", 3.0), ("npz", 3.0), ("pickle", 8.0)]
)
def test_another_file_takes_a_few_times_its_size(tmp_path: Path, kind: str, most: float):
    """A pickle of many small arrays costs more: an array of 2 numbers is 60 bytes in the file and 200 in memory.

    The limit has 300 MB beside it, of which what Arrow keeps for itself (up to 60 MB) is a part.
    """
    subprocess.run([sys.executable, "-c", WRITE, kind, tmp_path / kind], check=True)
    command = [sys.executable, "-c", PEAK + OTHERS[kind] + MEASURE_OTHERS, tmp_path / kind]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert 0.0 < float(done.stdout) < most
