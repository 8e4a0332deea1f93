"""OpenMVG's binary file says what its JSON says, in every version, with every kind of pointer."""

import json
import re

import foreign_openmvg_binary as mvg
import foreign_scene as fs
import numpy as np
import pytest

from sfm_audit.loaders import LoadError, open_model
from sfm_audit.loaders.datasets.image_counts import count_images


def both(tmp_path, data: dict):
    """The models of the JSON file and of the binary file with the same content."""
    one = fs.write(tmp_path / "json", {"sfm_data.json": json.dumps(data).encode()})
    other = fs.write(tmp_path / "bin", {"sfm_data.bin": mvg.openmvg_binary(data)})
    assert count_images(str(one)) == count_images(str(other)) == len(data["views"])
    return open_model(one), open_model(other)


def assert_same(one, other) -> None:
    for table in ("cameras", "images", "points", "observations"):
        for field in type(getattr(one, table)).__slots__:
            ours, theirs = (np.asarray(getattr(getattr(model, table), field)) for model in (one, other))
            assert np.array_equal(ours, theirs), (table, field)
    assert [finding.code for finding in one.findings] == [finding.code for finding in other.findings]


@pytest.mark.parametrize("version", ["0.1", "0.2", "0.3"])
def test_json_and_binary_are_the_same_model(tmp_path, version):
    data = fs.openmvg_data(fs.scene(), "pinhole_radial_k3") | {"sfm_data_version": version}
    data["control_points"] = data["structure"][:2]
    del data["extrinsics"][2]
    data["views"][0]["value"]["ptr_wrapper"]["data"] |= {"local_path": "a/b/", "id_view": 7}
    for row in (*data["views"], *data["intrinsics"], *data["extrinsics"][:1], *data["structure"][:1]):
        assert row["key"] < 10
    assert_same(*both(tmp_path, data))


def test_pointers_kinds_and_priors(tmp_path):
    data = fs.openmvg_data(fs.scene(), "pinhole_radial_k3")
    first = data["intrinsics"][0]["value"]
    again = {"polymorphic_id": 1, "ptr_wrapper": {"id": 2147483701, "data": first["ptr_wrapper"]["data"]}}
    shared = {"polymorphic_id": 1, "ptr_wrapper": {"id": 53}}  # 2147483701 without its highest bit
    data["intrinsics"] += [{"key": 1, "value": again}, {"key": 2, "value": shared}]
    views = [row["value"] for row in data["views"]]
    views[1]["ptr_wrapper"]["data"]["id_intrinsic"] = 2
    views[2] |= {"polymorphic_id": 2147483650, "polymorphic_name": "view_priors"}
    views[2]["ptr_wrapper"]["data"] |= {"center_weight": [1.0, 1.0, 1.0], "center": [3.0, 4.0, 5.0]}
    views[3]["polymorphic_id"] = 2  # the same kind, without a prior
    views[5]["ptr_wrapper"] = {"id": 5}  # view 4's
    one, other = both(tmp_path, data)
    assert_same(one, other)
    assert other.images.camera_id.tolist() == [0, 2, 0, 0, 0, 0]
    assert other.images.name[5] == "4.jpg"


def test_the_binary_file_is_read_where_both_lie_in_a_folder(tmp_path):
    made = fs.scene()
    bare = fs.openmvg_data(made, "pinhole") | {"structure": [], "extrinsics": []}
    files = mvg.openmvg_binary_files(made, "pinhole") | {"sfm_data.json": json.dumps(bare).encode()}
    model = open_model(fs.write(tmp_path, files))
    assert (model.file_format, len(model.images)) == ("openmvg_binary", 6)


def test_views_without_any_pose_are_counted(tmp_path):
    data = fs.openmvg_data(fs.scene(), "pinhole") | {"extrinsics": []}
    one, other = both(tmp_path, data)
    assert len(other.images) == len(one.images) == 0
    assert [(each.code, each.count) for each in one.findings] == [(each.code, each.count) for each in other.findings]


NUMBER = (2**40).to_bytes(8, "little")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda content: b"\x02" + content[1:],
            "byte 0: expected cereal's mark of the order of bytes, 0 or 1, found 2",
        ),
        (lambda content: content.replace(b"0.3", b"0.9", 1), "a version that is read (0.1, 0.2, 0.3), found '0.9'"),
        (lambda content: content[:26] + NUMBER + content[34:], f"{2**40} views, at least"),
        (lambda content: content.replace(b"pinhole", b"pinhale", 1), "a camera that is read (pinhole, "),
        (lambda content: content + b"\0", "the end of the file after its last part, found 1 more bytes"),
        (lambda content: content[:-8] + NUMBER, f"{2**40} control points, at least"),
        (lambda content: content[:12] + NUMBER + content[20:], f"{2**40} characters of the root path, at least"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_without_taking_memory(tmp_path, change, message):
    content = change(mvg.openmvg_binary_files(fs.scene(), "pinhole")["sfm_data.bin"])
    with pytest.raises(LoadError, match=re.escape(message)) as error:
        open_model(fs.write(tmp_path, {"sfm_data.bin": content}))
    assert "\n" not in str(error.value)


def test_a_key_twice_and_wrong_lengths_are_refused(tmp_path):
    made = fs.scene()
    for number, (part, change, message) in enumerate(
        [
            ("views", {"key": 0}, "a key of views that was not used before, found 0 again"),
            ("structure", {"value": {"X": [1.0, 2.0], "observations": []}}, "3 coordinates of a point, found 2"),
            ("extrinsics", {"value": {"rotation": [[1.0] * 3] * 3, "center": [0.0]}}, "3 numbers of a centre, found 1"),
        ]
    ):
        data = fs.openmvg_data(made, "pinhole")
        data[part][1] |= change
        folder = fs.write(tmp_path / str(number), {"sfm_data.bin": mvg.openmvg_binary(data)})
        with pytest.raises(LoadError, match=message):
            open_model(folder)
    data = fs.openmvg_data(made, "pinhole")
    data["structure"][3]["value"]["observations"][1]["value"]["x"] = [1.0, 2.0, 3.0]
    with pytest.raises(LoadError):
        open_model(fs.write(tmp_path / "last", {"sfm_data.bin": mvg.openmvg_binary(data)}))
