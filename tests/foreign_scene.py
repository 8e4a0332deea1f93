"""A scene with known numbers, and writers of it in the formats of other programs; nothing of the loaders is used here.

Every writer follows the documentation of its format (docs/datasets.md names it), and so does every ``*_residuals``,
which is the format's own definition of a residual.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from model_writer import Camera, Image, Model, Point, write_binary
from scipy.spatial.transform import Rotation

COLMAP_IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}
COLMAP_IDS |= {"FULL_OPENCV": 6, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "EQUIRECTANGULAR": 17}
PARAMS = {
    "SIMPLE_PINHOLE": "fx cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "fx cx cy k1",
    "RADIAL": "fx cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3",
    "SIMPLE_RADIAL_FISHEYE": "fx cx cy k1",
    "RADIAL_FISHEYE": "fx cx cy k1 k2",
    "EQUIRECTANGULAR": "width height",
}


@dataclass(frozen=True)
class Scene:
    """``lens``: of all images; px and dimensionless, OpenCV's meaning, first pixel centre at (0.5, 0.5)."""

    lens: dict
    width: int
    height: int
    rotations: np.ndarray  # (I, 3, 3) cam_from_world
    translations: np.ndarray  # (I, 3)
    points: np.ndarray  # (P, 3)
    image_idx: np.ndarray  # (M,) by point
    point_idx: np.ndarray
    xy: np.ndarray  # (M, 2)
    kind: str = "perspective"

    @property
    def centres(self) -> np.ndarray:
        return -np.einsum("nji,nj->ni", self.rotations, self.translations)

    def but(self, **changes: object) -> "Scene":
        return replace(self, **changes)


def distort(lens: dict, uv: np.ndarray) -> np.ndarray:
    u, v = uv.T
    k1, k2, k3, k4, p1, p2 = (lens.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    r2 = u**2 + v**2
    gain = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    return np.column_stack(
        [u * gain + 2 * p1 * u * v + p2 * (r2 + 2 * u**2), v * gain + 2 * p2 * u * v + p1 * (r2 + 2 * v**2)]
    )


def project(scene: Scene, xyz: np.ndarray) -> np.ndarray:
    """(n, 2) px of points in the camera frame."""
    lens = scene.lens
    if scene.kind == "spherical":
        longitude, latitude = np.arctan2(xyz[:, 0], xyz[:, 2]), np.arctan2(xyz[:, 1], np.hypot(xyz[:, 0], xyz[:, 2]))
        return np.column_stack([(0.5 + longitude / (2 * np.pi)) * scene.width, (0.5 + latitude / np.pi) * scene.height])
    uv = xyz[:, :2] / xyz[:, 2:]
    if scene.kind == "fisheye":
        radius = np.linalg.norm(uv, axis=1, keepdims=True)
        uv = uv * np.arctan(radius) / radius
    x, y = distort(lens, uv).T
    return np.column_stack([lens["fx"] * x + lens.get("skew", 0.0) * y + lens["cx"], lens["fy"] * y + lens["cy"]])


def scene(lens: dict | None = None, *, kind: str = "perspective", num_images: int = 6, num_points: int = 80) -> Scene:
    """Cameras around a box, noise of 0.5 px; its size is the smallest even one that holds all observations."""
    rng = np.random.default_rng(5)
    lens = {"fx": 620.0, "k1": -0.08, "k2": 0.03} | (lens or {})
    lens = {"fy": lens["fx"]} | lens
    points = rng.uniform((-2.0, -1.5, -1.0), (2.0, 1.5, 1.0), (num_points, 3))
    angles = np.linspace(-0.5, 0.5, num_images)
    rotations = np.array([Rotation.from_rotvec([0.1 * np.sin(7 * a), a, 0.2 * a]).as_matrix() for a in angles])
    translations = np.array([[0.2 * a, -0.1 * a, 6.0 + 0.3 * a] for a in angles])
    is_seen = rng.random((num_points, num_images)) < 0.9
    point_idx, image_idx = np.nonzero(is_seen)
    made = Scene(lens, 0, 0, rotations, translations, points, image_idx, point_idx, np.empty((0, 2)), kind)
    xyz = cam_points(made)
    noise = rng.normal(0.0, 0.5, (len(xyz), 2))
    if kind == "spherical":
        made = made.but(width=1600, height=800)
        return made.but(xy=project(made, xyz) + noise)
    shift = np.array([lens.get("cx", 0.0), lens.get("cy", 0.0)])  # from the centre
    centred = project(made.but(lens=lens | {"cx": 0.0, "cy": 0.0}), xyz) + shift + noise
    width, height = (2 * int(np.ceil(reach)) for reach in np.abs(centred).max(axis=0))
    half = np.array([width / 2, height / 2])
    lens |= {"cx": width / 2 + shift[0], "cy": height / 2 + shift[1]}
    return made.but(lens=lens, width=width, height=height, xy=centred + half)


def cam_points(made: Scene) -> np.ndarray:
    """(M, 3) the point of every observation in its camera's frame."""
    xyz = np.einsum("nij,nj->ni", made.rotations[made.image_idx], made.points[made.point_idx])
    return xyz + made.translations[made.image_idx]


def residuals(made: Scene) -> np.ndarray:
    """(M, 2) observed minus projected, px."""
    return made.xy - project(made, cam_points(made))


def quats(made: Scene) -> np.ndarray:
    """(I, 4) w x y z."""
    return np.roll(Rotation.from_matrix(made.rotations).as_quat(), 1, axis=1)


def write_colmap(folder: Path, made: Scene, model: str, *, camera_per_image: bool) -> Path:
    """The same scene as COLMAP's binary files; images, points and observations in the same order."""
    values = made.lens | {"width": float(made.width), "height": float(made.height)}
    params = tuple(float(values.get(name, 0.0)) for name in PARAMS[model].split())
    params += (0.0,) * (3 if model == "FULL_OPENCV" else 0)
    ids = range(len(made.rotations)) if camera_per_image else (0,)
    cameras = tuple(Camera(k, COLMAP_IDS[model], made.width, made.height, params) for k in ids)
    images, tracks = [], [[] for _ in made.points]
    for row, (quat, translation) in enumerate(zip(quats(made), made.translations, strict=True)):
        seen = np.flatnonzero(made.image_idx == row)
        links = tuple((*made.xy[k].tolist(), int(made.point_idx[k])) for k in seen)
        for position, k in enumerate(seen):
            tracks[made.point_idx[k]].append((row, position))
        pose = (*quat.tolist(), *translation.tolist())
        images.append(Image(row, f"{row}.jpg", links, pose, row if camera_per_image else 0))
    points = tuple(Point(k, tuple(tracks[k]), tuple(xyz.tolist()), -1.0) for k, xyz in enumerate(made.points))
    return write_binary(folder, Model(cameras, tuple(images), points))


def join(values) -> str:
    return " ".join(repr(float(value)) if isinstance(value, float) else str(value) for value in values)


def by_point(made: Scene):
    """Yield every point's position and the rows of its observations."""
    for row, xyz in enumerate(made.points):
        yield xyz.tolist(), np.flatnonzero(made.point_idx == row)


def centred_up(made: Scene) -> np.ndarray:
    """(M, 2) px from the image's centre, y up."""
    return (made.xy - (made.width / 2, made.height / 2)) * (1, -1)


FLIP = np.diag([1.0, -1.0, -1.0])


def bundler_files(made: Scene) -> dict[str, bytes]:
    lines = ["# Bundle file v0.3", f"{len(made.rotations)} {len(made.points)}"]
    for rotation, translation in zip(made.rotations, made.translations, strict=True):
        lines.append(join([made.lens["fx"], made.lens.get("k1", 0.0), made.lens.get("k2", 0.0)]))
        lines += [join(row) for row in (FLIP @ rotation).tolist()]
        lines.append(join((FLIP @ translation).tolist()))
    xy = centred_up(made)
    for xyz, rows in by_point(made):
        lines += [join(xyz), "10 20 30"]
        lines.append(f"{len(rows)} " + " ".join(join([made.image_idx[k], k, *xy[k].tolist()]) for k in rows))
    names = "".join(f"{row}.jpg 0 {made.lens['fx']}\n" for row in range(len(made.rotations)))
    return {"bundle.out": ("\n".join(lines) + "\n").encode(), "list.txt": names.encode()}


def bundler_residuals(made: Scene) -> np.ndarray:
    """Manual of Bundler v0.3: P = R X + t, p = -P / P.z, p' = f r(p) p; y up."""
    p = cam_points(made) @ FLIP.T
    p = -p[:, :2] / p[:, 2:]
    norm2 = (p**2).sum(axis=1, keepdims=True)
    return (
        centred_up(made)
        - made.lens["fx"] * (1.0 + made.lens.get("k1", 0.0) * norm2 + made.lens.get("k2", 0.0) * norm2**2) * p
    )


def bal_files(made: Scene) -> dict[str, bytes]:
    lines = [f"{len(made.rotations)} {len(made.points)} {len(made.xy)}"]
    xy = centred_up(made)
    lines += [join([made.image_idx[k], made.point_idx[k], *xy[k].tolist()]) for k in range(len(xy))]
    for rotation, translation in zip(made.rotations, made.translations, strict=True):
        lines += map(repr, Rotation.from_matrix(FLIP @ rotation).as_rotvec().tolist())
        lines += map(repr, (FLIP @ translation).tolist())
        lines += map(repr, [made.lens["fx"], made.lens.get("k1", 0.0), made.lens.get("k2", 0.0)])
    lines += map(repr, made.points.ravel().tolist())
    return {"problem-6-80-pre.txt": ("\n".join(lines) + "\n").encode()}


def nvm_files(made: Scene, distortion: float = 0.0) -> dict[str, bytes]:
    return {"scene.nvm": f"NVM_V3 \n\n{nvm_part(made, distortion)}0\n\n#the last part\n0\n".encode()}


def nvm_part(made: Scene, distortion: float = 0.0) -> str:
    lines = [f"{len(made.rotations)}"]
    for row, (quat, centre) in enumerate(zip(quats(made), made.centres, strict=True)):
        words = join([made.lens["fx"], *quat.tolist(), *centre.tolist(), distortion, 0])
        lines.append(f"{row}.jpg\t{words}")
    lines += ["", f"{len(made.points)}"]
    xy = made.xy - (made.width / 2, made.height / 2)
    for xyz, rows in by_point(made):
        views = " ".join(join([made.image_idx[k], k, *xy[k].tolist()]) for k in rows)
        lines.append(f"{join(xyz)} 10 20 30 {len(rows)} {views}")
    return "\n".join(lines) + "\n\n"


def nvm_residuals(made: Scene, distortion: float) -> np.ndarray:
    """PBA: f P / P.z - m (1 + d |m|^2 / f^2), px of the undistorted image; here observed minus projected."""
    p = cam_points(made)
    measured = made.xy - (made.width / 2, made.height / 2)
    norm2 = (measured**2).sum(axis=1, keepdims=True) / made.lens["fx"] ** 2
    return measured * (1.0 + distortion * norm2) - made.lens["fx"] * p[:, :2] / p[:, 2:]


def write(folder: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def opensfm_camera(made: Scene) -> dict:
    """io.py, camera_to_json: focal lengths and principal points as shares of the larger side."""
    size = max(made.width, made.height)
    lens, kind = made.lens, made.kind
    out = {"projection_type": kind, "width": made.width, "height": made.height}
    if kind == "spherical":
        return out
    if {"p1", "k3", "cx_shift"} & set(lens) or lens["fx"] != lens["fy"]:
        out |= {"projection_type": "brown", "focal_x": lens["fx"] / size, "focal_y": lens["fy"] / size}
        out |= {"c_x": (lens["cx"] - made.width / 2) / size, "c_y": (lens["cy"] - made.height / 2) / size}
        return out | {name: lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")}
    return out | {"focal": lens["fx"] / size, "k1": lens.get("k1", 0.0), "k2": lens.get("k2", 0.0)}


def opensfm_part(made: Scene, prefix: str = "") -> dict:
    shots = {}
    for row, (rotation, translation) in enumerate(zip(made.rotations, made.translations, strict=True)):
        vector = Rotation.from_matrix(rotation).as_rotvec().tolist()
        shots[f"{prefix}{row}.jpg"] = {"rotation": vector, "translation": translation.tolist(), "camera": "one"}
    points = {str(100 + row): {"color": [1, 2, 3], "coordinates": xyz.tolist()} for row, xyz in enumerate(made.points)}
    return {"cameras": {"one": opensfm_camera(made)}, "shots": shots, "points": points}


def opensfm_tracks(made: Scene, prefix: str = "") -> str:
    """tracks_manager.cc, version 2; normalised as features.py does it."""
    xy = (made.xy - (made.width / 2, made.height / 2)) / max(made.width, made.height)
    lines = []
    for k in range(len(xy)):
        words = (
            f"{prefix}{made.image_idx[k]}.jpg",
            100 + made.point_idx[k],
            k,
            *xy[k].tolist(),
            0.004,
            1,
            2,
            3,
            -1,
            -1,
        )
        lines.append("\t".join(map(str, words)))
    return "\n".join(lines) + "\n"


def opensfm_files(made: Scene) -> dict[str, bytes]:
    tracks = f"OPENSFM_TRACKS_VERSION_v2\n{opensfm_tracks(made)}"
    return {"reconstruction.json": json.dumps([opensfm_part(made)]).encode(), "tracks.csv": tracks.encode()}


OPENMVG_LENSES = {
    "pinhole": (None, ()),
    "pinhole_radial_k1": ("disto_k1", ("k1",)),
    "pinhole_radial_k3": ("disto_k3", ("k1", "k2", "k3")),
    "pinhole_brown_t2": ("disto_t2", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def openmvg_data(made: Scene, kind: str, *, wrapped: bool = False) -> dict:
    """sfm_data.json as cereal writes it; ``wrapped``: what the base class writes stands in value0."""
    base = {"width": made.width, "height": made.height, "focal_length": made.lens["fx"]}
    base |= {"principal_point": [made.lens["cx"], made.lens["cy"]]}
    key, names = OPENMVG_LENSES[kind]
    data = {"value0": base} if wrapped else base
    if key:
        data = data | {key: [made.lens.get(name, 0.0) for name in names]}
    ids = range(len(made.rotations))
    views, extrinsics, structure = [], [], []
    for row in ids:
        view = {"local_path": "", "filename": f"{row}.jpg", "width": made.width, "height": made.height}
        view |= {"id_view": row, "id_intrinsic": 0, "id_pose": row}
        pointer = {"id": 2147483649 + row, "data": view}
        views.append({"key": row, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": pointer}})
    for row, (rotation, centre) in enumerate(zip(made.rotations, made.centres, strict=True)):
        extrinsics.append({"key": row, "value": {"rotation": rotation.tolist(), "center": centre.tolist()}})
    for row, (xyz, seen) in enumerate(by_point(made)):
        found = [{"key": int(made.image_idx[k]), "value": {"id_feat": int(k), "x": made.xy[k].tolist()}} for k in seen]
        structure.append({"key": row, "value": {"X": xyz, "observations": found}})
    value = {"polymorphic_id": 2147483649, "polymorphic_name": kind, "ptr_wrapper": {"id": 2147483700, "data": data}}
    out = {"sfm_data_version": "0.3", "root_path": "images", "views": views, "intrinsics": [{"key": 0, "value": value}]}
    return out | {"extrinsics": extrinsics, "structure": structure, "control_points": []}


def openmvg_files(made: Scene, kind: str = "pinhole_radial_k3", *, wrapped: bool = False) -> dict[str, bytes]:
    return {"sfm_data.json": json.dumps(openmvg_data(made, kind, wrapped=wrapped)).encode()}


def tag(name: str, *content: object) -> str:
    return f"<{name}>{''.join(map(str, content))}</{name}>\n"


ORIENTATIONS = {
    "XRightYDown": np.eye(3),
    "XRightYUp": np.diag([1.0, -1.0, -1.0]),
    "XLeftYUp": np.diag([-1.0, -1.0, 1.0]),
    "XDownYRight": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}


def blocks_exchange_xml(made: Scene, orientation: str = "XRightYDown", system: str = "") -> str:
    """Bentley's specification: pixels begin at the centre of the first one; P1 and P2 are OpenCV's p2 and p1."""
    lens = made.lens
    axes = ORIENTATIONS[orientation]
    photos = []
    for row, (rotation, centre) in enumerate(zip(made.rotations, made.centres, strict=True)):
        matrix = axes @ rotation
        numbers = [tag(f"M_{i}{j}", repr(float(matrix[i, j]))) for i in range(3) for j in range(3)]
        at = [tag(axis, repr(value)) for axis, value in zip("xyz", centre.tolist(), strict=True)]
        pose = tag("Pose", tag("Rotation", *numbers), tag("Center", *at))
        photos.append(tag("Photo", tag("Id", row), tag("ImagePath", f"{row}.jpg"), pose))
    names = {"K1": "k1", "K2": "k2", "K3": "k3", "P1": "p2", "P2": "p1"}
    group = [
        tag("ImageDimensions", tag("Width", made.width), tag("Height", made.height)),
        tag("FocalLengthPixels", repr(lens["fx"])),
        tag("AspectRatio", repr(lens["fy"] / lens["fx"])),
        tag("CameraOrientation", orientation),
        tag("PrincipalPoint", *(tag(axis, repr(float(lens[f"c{axis}"]) - 0.5)) for axis in "xy")),
        tag("Distortion", *(tag(theirs, repr(lens.get(ours, 0.0))) for theirs, ours in names.items())),
    ]
    ties = []
    for xyz, rows in by_point(made):
        seen = [
            tag(
                "Measurement",
                tag("PhotoId", made.image_idx[k]),
                *(tag(a, repr(v - 0.5)) for a, v in zip("xy", xy, strict=True)),
            )
            for k, xy in zip(rows, made.xy[rows].tolist(), strict=True)
        ]
        position = tag("Position", *(tag(axis, repr(value)) for axis, value in zip("xyz", xyz, strict=True)))
        ties.append(tag("TiePoint", position, *seen))
    block = tag("Block", system, tag("Photogroups", tag("Photogroup", *group, *photos)), tag("TiePoints", *ties))
    return f'<?xml version="1.0" encoding="utf-8"?>\n<BlocksExchange version="2.1">\n{block}</BlocksExchange>\n'


def blocks_exchange_files(made: Scene, orientation: str = "XRightYDown") -> dict[str, bytes]:
    return {"BlocksExchange.xml": blocks_exchange_xml(made, orientation).encode()}


def kapture_files(made: Scene, *, with_rig: bool = False) -> dict[str, bytes]:
    """kapture/io/csv.py, format 1.1; COLMAP's camera RADIAL."""
    lens = made.lens
    head = "# kapture format: 1.1\n"
    values = [made.width, made.height, *(float(lens.get(name, 0.0)) for name in ("fx", "cx", "cy", "k1", "k2"))]
    sensors = f"cam0, , camera, RADIAL, {', '.join(map(repr, values))}\n"
    records, trajectories, keypoints = "", "", {}
    positions = {}
    for row, (quat, translation) in enumerate(zip(quats(made), made.translations, strict=True)):
        device, moved = ("rig", translation - [0.5, 0.0, 0.25]) if with_rig else ("cam0", translation)
        records += f"{row}, cam0, {row}.jpg\n"
        trajectories += f"{row}, {device}, {', '.join(map(repr, [*quat.tolist(), *moved.tolist()]))}\n"
        seen = np.flatnonzero(made.image_idx == row)
        positions |= {k: position for position, k in enumerate(seen)}
        content = np.hstack([made.xy[seen], made.xy[seen]]).astype("<f8").tobytes()
        keypoints[f"reconstruction/keypoints/SIFT/{row}.jpg.kpt"] = content
    points = "".join(", ".join(map(repr, xyz)) + ", 1, 2, 3\n" for xyz in made.points.tolist())
    observations = ""
    for row, (_, seen) in enumerate(by_point(made)):
        words = [word for k in seen for word in (f"{made.image_idx[k]}.jpg", str(positions[k]))]
        observations += ", ".join([str(row), "SIFT", *words]) + "\n"
    files = {
        "sensors/sensors.txt": sensors,
        "sensors/records_camera.txt": records,
        "reconstruction/points3d.txt": points,
    }
    files |= {"sensors/trajectories.txt": trajectories, "reconstruction/observations.txt": observations}
    files |= {"reconstruction/keypoints/SIFT/keypoints.txt": "SIFT, float64, 4\n"}
    if with_rig:
        files["sensors/rigs.txt"] = "rig, cam0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.25\n"
    return {name: (head + text).encode() for name, text in files.items()} | keypoints
