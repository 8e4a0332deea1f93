"""BlocksExchange and kapture: what is particular about them; and files that hold no points at all."""

import re

import foreign_scene as fs
import numpy as np
import pytest
from numpy.testing import assert_allclose

from sfm_audit.audit.engine.model import ModelAuditor
from sfm_audit.loaders import FindingCode, LoadError, discover, open_model
from sfm_audit.loaders.foreign import xml_file


def residuals_of(model) -> tuple[ModelAuditor, np.ndarray]:
    auditor = ModelAuditor(model)
    return auditor, auditor.residuals.residuals_px.T


def by_image(made: fs.Scene, rows: np.ndarray) -> np.ndarray:
    """Order rows of the scene's observations like the audit's: by image."""
    return rows[np.argsort(made.image_idx, kind="stable")]


@pytest.mark.parametrize("orientation", fs.ORIENTATIONS)
def test_axes_of_a_photogroup_are_those_it_names(tmp_path, orientation):
    made = fs.scene()
    model = open_model(fs.write(tmp_path, fs.blocks_exchange_files(made, orientation)))
    assert_allclose(residuals_of(model)[1], by_image(made, fs.residuals(made)), atol=1e-8)


BENTLEY_ROTATION = (-0.9999982912233401, -0.001636319085375301, -0.0008602425863163225, -0.001631068695467463)
BENTLEY_ROTATION += (0.9999802528616577, -0.00606906089589293, 0.0008701565192966738, -0.006067647409696231)
BENTLEY_ROTATION += (-0.9999812130648239,)
BENTLEY_POINTS = {
    (652119.8871409688, 6863304.305716386, 87.79328384995461): (3324.26001, 9930.269531),
    (652123.2211166573, 6863245.976366176, 80.07999999914318): (3296.56, 9253.75),
}


def test_the_example_of_bentley_s_specification_has_residuals_below_a_pixel(tmp_path):
    """BlocksExchange XML/XMLZ format, version 2.1: photo 146, a tie point and control point 2, as measured there."""
    tag = fs.tag
    numbers = dict(zip((f"M_{row}{column}" for row in range(3) for column in range(3)), BENTLEY_ROTATION, strict=True))
    centre = {"x": 651999.7159189156, "y": 6863073.633923346, "z": 1318.897690166719}
    pose = tag(
        "Pose", tag("Rotation", *map(tag, numbers, numbers.values())), tag("Center", *map(tag, centre, centre.values()))
    )
    lens = {"K1": -0.0010041516639, "K2": 0.0056007056563, "K3": -0.009874171117100001, "P1": 0, "P2": 0}
    group = [
        tag("ImageDimensions", tag("Width", 9420), tag("Height", 14430)),
        tag("FocalLengthPixels", 13991.05582),
        tag("CameraOrientation", "XRightYDown"),
        tag("PrincipalPoint", tag("x", 4683.755692), tag("y", 7223.0141002)),
        tag("Distortion", *map(tag, lens, lens.values())),
        tag("Photo", tag("Id", 146), tag("ImagePath", "071_2810.jpg"), pose),
    ]
    ties = [
        tag(
            "TiePoint",
            tag("Position", *map(tag, "xyz", xyz)),
            tag("Measurement", tag("PhotoId", 146), *map(tag, "xy", xy)),
        )
        for xyz, xy in BENTLEY_POINTS.items()
    ]
    block = tag("Block", tag("Photogroups", tag("Photogroup", *group)), tag("TiePoints", *ties))
    model = open_model(fs.write(tmp_path, {"BlocksExchange.xml": tag("BlocksExchange", block).encode()}))
    assert model.image(0).camera.model.name == "RADIAL_3"
    assert np.hypot(*residuals_of(model)[1].T).max() < 0.4  # half a pixel beside it would be 0.6 and more


SYSTEMS = fs.tag("SpatialReferenceSystems", fs.tag("SRS", fs.tag("Id", 0), fs.tag("Definition", "EPSG:4326")))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "<BlocksExchange version",
            "<!DOCTYPE a [<!ENTITY b 'c'>]>\n<BlocksExchange version",
            "without a document type",
        ),
        ("0.jpg", "&b;", "undefined entity"),
        ("<BlocksExchange version", "<Other version", "<BlocksExchange> as the outermost element, found <Other>"),
        ("<Block>", "<a>" * 100, "at most 64 elements inside each other"),
        ("0.jpg", "0" * 70_000, "at most 65536 characters in <ImagePath>"),
        ("<Id>1</Id>", "<Id>0</Id>", "Id that the file has not used before, found 0 again"),
        ("<Id>1</Id>", "<Id>-1</Id>", "a whole number below 2^32 in <Id> of <Photo>, found '-1'"),
        ("<M_00>", "<Omega>1</Omega><N_00>", "mismatched tag"),
        (
            "<CameraOrientation>XRightYDown",
            "<CameraOrientation>XRightYRight",
            "a CameraOrientation such as XRightYDown",
        ),
        ("<AspectRatio>", "<Skew>0.1</Skew><AspectRatio>", "no Skew, found 0.1"),
        ("<AspectRatio>", "<CameraModelType>Fisheye</CameraModelType><AspectRatio>", "CameraModelType Perspective"),
        ("<Block>", f"{SYSTEMS}<Block><SRSId>0</SRSId>", "coordinates in metres, found degrees ('EPSG:4326')"),
        ("<Block>", "<Block></Block><Block>", "one block, found another one"),
    ],
)
def test_what_is_wrong_with_a_block_is_said_in_one_line(tmp_path, old, new, message):
    xml = fs.blocks_exchange_xml(fs.scene())
    assert old in xml
    folder = fs.write(tmp_path, {"my BlocksExchange 2.xml": xml.replace(old, new, 1).encode()})
    with pytest.raises(LoadError, match=re.escape(message)) as error:
        open_model(folder)
    assert "\n" not in str(error.value)


def test_millimetres_photos_without_a_pose_and_points_without_a_position(tmp_path):
    made = fs.scene()
    xml = fs.blocks_exchange_xml(made)
    mm = fs.tag("FocalLength", 24.0) + fs.tag("SensorSize", repr(24.0 / made.lens["fx"] * max(made.width, made.height)))
    xml = re.sub("<FocalLengthPixels>.*</FocalLengthPixels>\n", mm, xml)
    xml = re.sub("<Pose>.*?</Pose>\n", "", xml, count=1, flags=re.DOTALL)
    xml = re.sub("<Position>.*?</Position>\n", "", xml, count=1, flags=re.DOTALL)
    model = open_model(fs.write(tmp_path, {"BlocksExchange.xml": xml.encode()}))
    assert model.images.image_id.tolist() == [1, 2, 3, 4, 5]
    assert len(model.points) == 79
    kept = (made.image_idx > 0) & (made.point_idx > 0)
    assert_allclose(residuals_of(model)[1], by_image(made, fs.residuals(made))[by_image(made, kept)], atol=1e-8)
    assert model.images.num_points2d.sum() == np.count_nonzero(made.image_idx > 0)


def test_blanks_between_elements_do_not_add_up(tmp_path, monkeypatch):
    monkeypatch.setattr(xml_file, "MAX_TEXT", 40)
    assert len(open_model(fs.write(tmp_path, fs.blocks_exchange_files(fs.scene()))).points) == 80


def test_bytes_of_an_xml_file_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(xml_file, "MAX_BYTES", 1000)
    with pytest.raises(LoadError, match="at most 1000 bytes of XML"):
        open_model(fs.write(tmp_path, fs.blocks_exchange_files(fs.scene())))


def test_transforms_json_has_no_points_and_names_the_model_beside_it(tmp_path):
    folder = fs.write(tmp_path / "scene", {"transforms.json": b"{}"})
    said = (
        "expected a model with points.*, found transforms.json .* holds cameras and no points; audit the COLMAP model"
    )
    with pytest.raises(LoadError, match=said):
        open_model(folder)
    (error,) = discover([folder]).errors
    assert re.search(said, str(error))
    model = fs.write_colmap(folder / "colmap" / "sparse" / "0", fs.scene(), "RADIAL", camera_per_image=False)
    with pytest.raises(LoadError, match=re.escape(f"audit the COLMAP model that it was made from, {model}")):
        open_model(folder)
    assert [ref.model_path for ref in discover([folder]).refs] == [str(model)]


def test_metashape_s_cameras_have_no_tie_points(tmp_path):
    folder = fs.write(tmp_path, {"cameras.xml": b"<document/>"})
    with pytest.raises(
        LoadError, match=r"found cameras.xml, Metashape's own export of cameras, holds no tie points; export"
    ):
        open_model(folder)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("reconstruction/observations.txt", b"0.jpg", b"../../0.jpg", None),
        ("reconstruction/observations.txt", b"SIFT", b"../SIFT", "names of images and keypoints inside the folder"),
        ("reconstruction/observations.txt", b"format: 1.1", b"format: 1.0", "expected kapture format: 1.1, found 1.0"),
        ("sensors/sensors.txt", b"RADIAL", b"BROWN", "a camera model of COLMAP's, found 'BROWN'"),
        ("sensors/records_camera.txt", b"1.jpg", b"0.jpg", "an image that the file has not named before"),
        ("reconstruction/keypoints/SIFT/keypoints.txt", b"float64", b"object", "the dtype float32 or float64"),
        ("reconstruction/keypoints/SIFT/keypoints.txt", b", 4", b", 7", "rows of 7 numbers of 8 bytes"),
    ],
)
def test_what_is_wrong_with_kapture_is_said_and_no_file_outside_is_opened(tmp_path, file, old, new, message):
    files = fs.kapture_files(fs.scene())
    assert old in files[file]
    folder = fs.write(tmp_path, files | {file: files[file].replace(old, new, 1)}) / "reconstruction"
    if message is None:
        assert FindingCode.OBSERVATIONS_WITHOUT_IMAGE in {finding.code for finding in open_model(folder).findings}
        return
    with pytest.raises(LoadError, match=message):
        open_model(folder)


def test_a_kapture_image_whose_name_leads_out_has_no_keypoints(tmp_path):
    files = {name: text.replace(b"0.jpg", b"../../0.jpg") for name, text in fs.kapture_files(fs.scene()).items()}
    with pytest.raises(LoadError, match=r"names of images and keypoints inside the folder, found '../../0.jpg"):
        open_model(fs.write(tmp_path, files) / "reconstruction")
