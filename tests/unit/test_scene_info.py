"""scene_info files of LoFTR and of D2-Net / glue-factory, made here: what goes, and that the rest is as it was."""

import pickle
import zipfile

import numpy as np
import pytest
from corpus import CORPUS, needs_corpus

from sfm_audit.loaders import LoadError
from sfm_audit.loaders.scene_info.file import read_scene_info
from sfm_audit.reports.export.scene_info import Match, drop_images, match_images, removed_table, scene_info_bytes
from sfm_audit.reports.export.selection import AuditedImage, Keep

NUM = 6
NAMES = [f"{i:03d}_o.jpg" for i in range(NUM)]
ABSENT = 2  # an image without a path


def objects(items):
    out = np.empty(len(items), dtype=object)
    for index, item in enumerate(items):
        out[index] = item
    return out


def per_image(make):
    return objects([None if i == ABSENT else make(i) for i in range(NUM)])


def loftr():
    rng = np.random.default_rng(0)
    pairs = [(i, j) for i in range(NUM) for j in range(NUM) if i < j and ABSENT not in (i, j)]
    return {
        "image_paths": per_image(lambda i: f"Undistorted_SfM/0022/images/{NAMES[i]}"),
        "depth_paths": per_image(lambda i: f"phoenix/S6/zl548/MegaDepth_v1/0022/dense0/depths/{NAMES[i][:-4]}.h5"),
        "intrinsics": per_image(lambda i: np.eye(3) * (i + 1)),
        "poses": per_image(lambda i: np.eye(4) * (i + 1)),
        "pair_infos": [(np.array(p), np.float64(0.1 * sum(p)), rng.random(4)) for p in pairs],
    }


def d2net(*, absent=True):
    rng = np.random.default_rng(1)
    overlap = rng.random((NUM, NUM))
    scale = rng.random((NUM, NUM)) * 3
    values = {name: value for name, value in loftr().items() if name != "pair_infos"}
    if absent:
        overlap[ABSENT] = overlap[:, ABSENT] = scale[ABSENT] = scale[:, ABSENT] = -1.0
    else:
        values["image_paths"] = np.array([f"MegaDepth_v1_SfM/0022/images/{name}" for name in NAMES])
        values["depth_paths"] = np.array([f"x/0022/dense0/depths/{name}" for name in NAMES])
        values["intrinsics"] = np.stack([np.eye(3) * i for i in range(NUM)])
        values["poses"] = np.stack([np.eye(4).ravel() * i for i in range(NUM)])
    return {
        **values,
        "points3D_id_to_2D": objects([{i: [1.0, 2.0], 7: [3.0, 4.0]} for i in range(NUM)]),
        "overlap_matrix": overlap,
        "scale_ratio_matrix": scale,
        "angles": rng.random((NUM, NUM)),
    }


def write_pickle(path, values, protocol=4):
    path.write_bytes(pickle.dumps(values, protocol))
    return path


def images(verdicts, scene="0022", component="0", names=NAMES):
    return [
        AuditedImage("m", scene, component, f"{scene}/{component}", i, name, verdict, ("r: 1",))
        for i, (name, verdict) in enumerate(zip(names, verdicts, strict=True))
    ]


VERDICTS = ["accepted", "rejected", "accepted", "undetermined", "accepted", "rejected"]


def filtered(path, said, keep=Keep.NOT_REJECTED):
    """Return the filtered file's bytes, with what was matched."""
    info = read_scene_info(path)
    matched = match_images(info, said, keep)
    gone = np.zeros(len(info.image_paths), dtype=bool)
    gone[[item.index for item in matched if item.match is Match.REMOVED]] = True
    result = drop_images(info, gone)
    return scene_info_bytes(info, result), matched, result


def same(one, other):
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        if one.dtype == object:
            for a, b in zip(one.ravel(), other.ravel(), strict=True):
                same(a, b)
        else:
            np.testing.assert_array_equal(one, other)
    elif isinstance(one, (list, tuple)):
        assert type(one) is type(other)
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            same(a, b)
    else:
        assert type(one) is type(other)
        assert one == other


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_loftr_loses_pairs_and_nothing_else(protocol, tmp_path):
    values = loftr()
    content, _, result = filtered(write_pickle(tmp_path / "in.npz", values, protocol), images(VERDICTS))
    (tmp_path / "out.npz").write_bytes(content)
    out = np.load(tmp_path / "out.npz", allow_pickle=True)  # as LoFTR reads it; our own file
    assert list(out) == list(values)
    wanted = [info for info in values["pair_infos"] if not {1, 5} & set(info[0].tolist())]
    assert 0 < len(wanted) < len(values["pair_infos"])
    same(out["pair_infos"], wanted)
    for name in ("image_paths", "depth_paths", "intrinsics", "poses"):
        same(out[name], values[name])
    assert (result.num_pairs_before, result.num_pairs) == (len(values["pair_infos"]), len(wanted))
    assert content[1] == protocol


def test_pickles_name_numpy_as_the_file_did(tmp_path):
    data = pickle.dumps(loftr(), 3)
    assert b"numpy._core.multiarray" in data
    for old, new in ((b"numpy._core.", b"numpy._core."), (b"numpy._core.", b"numpy.core.")):
        (tmp_path / "in.npz").write_bytes(data.replace(old, new))
        content = filtered(tmp_path / "in.npz", images(VERDICTS))[0]
        assert new in content
        assert (b"numpy._core" in content) == (new == b"numpy._core.")


def test_what_is_filtered_twice_is_filtered_once(tmp_path):
    for name, write in (("a", write_pickle), ("b", lambda p, v: (np.savez(p, **v), p)[1])):
        values = loftr() if name == "a" else d2net()
        once = filtered(write(tmp_path / f"{name}.npz", values), images(VERDICTS))[0]
        (tmp_path / "once.npz").write_bytes(once)
        assert filtered(tmp_path / "once.npz", images(VERDICTS))[0] == once


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize("absent", [True, False])
def test_d2net_marks_images_as_its_own_script_marks_absent_ones(save, absent, tmp_path):
    values = d2net(absent=absent)
    save(tmp_path / "in.npz", **values)
    content, _, result = filtered(tmp_path / "in.npz", images(VERDICTS))
    (tmp_path / "out.npz").write_bytes(content)
    gone, kept = [1, 5], [0, 2, 3, 4]
    with np.load(tmp_path / "out.npz", allow_pickle=True) as out:  # as glue-factory reads it; our own file
        assert out.files == list(values)
        for name in ("overlap_matrix", "scale_ratio_matrix"):
            wanted = values[name].copy()
            wanted[gone] = wanted[:, gone] = -1.0
            same(out[name], wanted)
        for name in ("image_paths", "depth_paths", "intrinsics", "poses"):
            assert out[name].shape == (NUM,)
            assert out[name][gone].tolist() == [None, None]
            for index in kept:
                if values[name][index] is None:
                    assert out[name][index] is None
                else:
                    np.testing.assert_array_equal(out[name][index], values[name][index])
        for name in ("points3D_id_to_2D", "angles"):
            same(out[name], values[name])
        valid = np.array([path is not None for path in out["image_paths"]])
        assert (out["overlap_matrix"][valid][:, valid] >= 0).all(), (
            "glue-factory: no negative pair with a removed image"
        )
    with zipfile.ZipFile(tmp_path / "in.npz") as old, zipfile.ZipFile(tmp_path / "out.npz") as new:
        assert [e.compress_type for e in old.infolist()] == [e.compress_type for e in new.infolist()]
        for name in ("points3D_id_to_2D.npy", "angles.npy"):
            assert old.read(name) == new.read(name)
    assert 0 < result.num_pairs < result.num_pairs_before


@pytest.mark.parametrize("make", [loftr, d2net])
def test_nothing_removed_changes_no_value(make, tmp_path):
    values = make()
    path = tmp_path / "in.npz"
    if "pair_infos" in values:
        write_pickle(path, values)
    else:
        np.savez(path, **values)
    content, _, result = filtered(path, images(["accepted"] * NUM))
    assert result.num_pairs == result.num_pairs_before
    (tmp_path / "out.npz").write_bytes(content)
    out = np.load(tmp_path / "out.npz", allow_pickle=True)
    for name, value in values.items():
        same(out[name], value)


def test_accepted_removes_the_undetermined_too(tmp_path):
    path = write_pickle(tmp_path / "in.npz", loftr())
    assert [m.index for m in filtered(path, images(VERDICTS), Keep.ACCEPTED)[1] if m.match is Match.REMOVED] == [
        1,
        3,
        5,
    ]


def match_of(tmp_path, said):
    values = loftr()
    info = read_scene_info(write_pickle(tmp_path / "in.npz", values))
    return {item.index: item.match for item in match_images(info, said, Keep.NOT_REJECTED)}


def test_images_are_looked_for_in_their_scene(tmp_path):
    said = [*images(["accepted"] * NUM), *images(["rejected"] * NUM, scene="0015")]
    assert set(match_of(tmp_path, said).values()) == {Match.KEPT}


def test_the_only_scene_of_a_run_is_meant_whatever_it_is_called(tmp_path):
    assert match_of(tmp_path, images(VERDICTS, scene="my model"))[1] is Match.REMOVED
    two = [*images(VERDICTS, scene="x"), *images(VERDICTS, scene="y")]
    assert set(match_of(tmp_path, two).values()) == {Match.UNKNOWN}


def test_unknown_images_are_kept_and_listed(tmp_path):
    path = write_pickle(tmp_path / "in.npz", loftr())
    _, matched, _ = filtered(path, images(VERDICTS)[:5])
    assert {m.index: m.match for m in matched} == {
        0: Match.KEPT,
        1: Match.REMOVED,
        3: Match.KEPT,
        4: Match.KEPT,
        5: Match.UNKNOWN,
    }
    table = removed_table(matched).splitlines()
    assert table[0].startswith("action,index,image_path,")
    assert [line.split(",")[:2] for line in table[1:]] == [["removed", "1"], ["kept_unknown", "5"]]
    assert "r: 1" in table[1]


def test_components_decide_by_the_depth_path_and_else_are_ambiguous_where_they_differ(tmp_path):
    both = [*images(VERDICTS), *images(["rejected"] * NUM, component="1")]
    assert match_of(tmp_path, both)[0] is Match.KEPT
    assert match_of(tmp_path, both)[1] is Match.REMOVED
    others = [*images(VERDICTS, component="3"), *images(["rejected"] * NUM, component="1")]
    found = match_of(tmp_path, others)
    assert found[0] is Match.AMBIGUOUS
    assert found[1] is Match.REMOVED, "all that it can be were rejected"


def test_folders_in_names_count_as_far_as_both_give_them(tmp_path):
    names = [f"images/{name}" for name in NAMES]
    assert match_of(tmp_path, images(VERDICTS, names=names))[1] is Match.REMOVED
    other = [f"left/{name}" for name in NAMES]
    assert match_of(tmp_path, images(VERDICTS, names=other))[1] is Match.UNKNOWN


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pair_infos": 3}, "no list"),
        ({"pair_infos": [(np.array([0, NUM]), 0.1, None)]}, "none of the 6 images"),
        ({"pair_infos": [(np.array([-1, 2]), 0.1, None)]}, "none of the 6 images"),
        ({"pair_infos": [(np.array([0.5, 1]), 0.1, None)]}, "two indices"),
        ({"pair_infos": [("01", 0.1)]}, "two indices"),
        ({"image_paths": [1, 2]}, "no path"),
        ({"poses": np.zeros((3, 4))}, "poses of another length"),
        ({"overlap_matrix": np.zeros((2, 2))}, "6 x 6"),
    ],
)
def test_files_that_make_no_sense_are_one_line(change, message, tmp_path):
    path = write_pickle(tmp_path / "in.npz", {**loftr(), **change})
    with pytest.raises(LoadError, match=message) as caught:
        read_scene_info(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not an archive", b"\x93NUMPY", b"hello", pickle.dumps([1])])
def test_other_files_are_one_line(content, tmp_path):
    (tmp_path / "in.npz").write_bytes(content)
    with pytest.raises(LoadError) as caught:
        read_scene_info(tmp_path / "in.npz")
    assert "\n" not in str(caught.value)


def test_a_cut_archive_is_refused_at_every_byte(tmp_path):
    np.savez(tmp_path / "in.npz", **d2net())
    data = (tmp_path / "in.npz").read_bytes()
    for end in range(0, len(data), 97):
        (tmp_path / "cut.npz").write_bytes(data[:end])
        with pytest.raises(LoadError):
            read_scene_info(tmp_path / "cut.npz")


def test_an_array_that_promises_more_than_the_file_holds_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "in.npz", "w") as archive, archive.open("overlap_matrix.npy", "w") as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40, 1 << 10)}
        np.lib.format.write_array_header_1_0(member, header)
    with pytest.raises(LoadError, match="elements with 0 bytes"):
        read_scene_info(tmp_path / "in.npz")


@needs_corpus
@pytest.mark.corpus
def test_the_sample_of_the_benchmark(tmp_path):
    info = read_scene_info(CORPUS / "scene_info" / "0022_0.1_0.3.npz")
    there = [i for i, path in enumerate(info.image_paths) if path is not None]
    assert (len(info.image_paths), len(there), len(info.pairs)) == (1930, 553, 300)
    names = [info.image_paths[i].rsplit("/", 1)[1] for i in there]
    rejected = set(there[::7])
    said = images(["rejected" if i in rejected else "accepted" for i in there], names=names)
    content, matched, result = filtered(CORPUS / "scene_info" / "0022_0.1_0.3.npz", said)
    assert {m.index for m in matched if m.match is Match.REMOVED} == rejected
    (tmp_path / "out.npz").write_bytes(content)
    out = read_scene_info(tmp_path / "out.npz")
    stays = [not rejected & set(pair) for pair in info.pairs.tolist()]
    assert 0 < result.num_pairs == sum(stays) < 300
    assert out.pairs.tolist() == info.pairs[np.array(stays)].tolist()
    same(out.values["pair_infos"], [x for x, is_kept in zip(info.values["pair_infos"], stays, strict=True) if is_kept])
    for name in ("image_paths", "depth_paths", "intrinsics", "poses"):
        same(out.values[name], info.values[name])
    assert (out.protocol, out.numpy_core) == (info.protocol, info.numpy_core)
    same(np.load(tmp_path / "out.npz", allow_pickle=True)["pair_infos"], out.values["pair_infos"])  # written by us
