"""A repeated run audits a model of another program again where any file that it was read from has changed."""

import os
from pathlib import Path

import foreign_openmvg_binary as mvg
import foreign_scene as fs
import pytest

from sfm_audit.loaders import discover
from sfm_audit.loaders.datasets.input_state import is_unchanged, read_input_state

MADE = fs.scene({"k1": -0.08, "k2": 0.0}, num_images=3, num_points=12)
FILES = {
    "bundler": fs.bundler_files(MADE),
    "bal": fs.bal_files(MADE),
    "nvm": fs.nvm_files(MADE, 0.05),
    "opensfm": fs.opensfm_files(MADE),
    "blocks_exchange": fs.blocks_exchange_files(MADE),
    "kapture": fs.kapture_files(MADE, with_rig=True),
    "openmvg": fs.openmvg_files(MADE),
    "openmvg_binary": mvg.openmvg_binary_files(MADE),
}
BELOW = {"kapture": "reconstruction"}


@pytest.mark.parametrize("name", FILES)
def test_every_file_that_is_read_is_looked_at_when_a_run_is_repeated(tmp_path: Path, name: str):
    files = FILES[name]
    location = str(fs.write(tmp_path, files) / BELOW.get(name, ""))
    known = read_input_state(location)
    assert is_unchanged(location, known, verify=True)
    assert known.num_bytes == sum(map(len, files.values()))
    for file, content in files.items():
        path = tmp_path / file
        before = path.stat()
        path.write_bytes(content[:-2] + bytes([content[-2] ^ 1]) + content[-1:])
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        assert not is_unchanged(location, known, verify=True), f"{file} has other content"
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 10**9))
        assert not is_unchanged(location, known, verify=False), f"{file} has another time"
        path.write_bytes(content)
        assert is_unchanged(location, known, verify=False), "the content is the old one again"
    if name == "bundler":
        (tmp_path / "list.txt").unlink()
        assert not is_unchanged(location, known, verify=False)


def test_a_new_keypoint_file_a_loop_and_a_link_that_leads_out(tmp_path: Path):
    outside = tmp_path / "outside.kpt"
    outside.write_bytes(b"0" * 32)
    files = fs.kapture_files(MADE)
    root = fs.write(tmp_path / "data", files)
    location = str(root / "reconstruction")
    known = read_input_state(location)
    keypoints = root / "reconstruction" / "keypoints"
    (keypoints / "loop").symlink_to(keypoints, target_is_directory=True)
    assert is_unchanged(location, known, verify=False)
    (keypoints / "SIFT" / "new.jpg.kpt").write_bytes(b"0" * 32)
    assert not is_unchanged(location, known, verify=False)
    (keypoints / "SIFT" / "link.jpg.kpt").symlink_to(outside)
    found = discover([root])
    assert not found.refs
    assert "links to the outside: keypoints/SIFT/link.jpg.kpt" in str(found.errors[0])
    assert discover([root], follow_links=True).refs
