"""A made-up format of one text file, ``model.toy``: all that adding a format takes, beside its entry in the list.

Lines: ``C id width height f cx cy k``, ``I id camera qw qx qy qz tx ty tz name``, ``P id x y z``,
``O image x y point``. It stores no tracks, no errors of points, and only linked 2D points.
"""

import numpy as np

from sfm_audit.loaders.assembly.raw import (
    RawCamera,
    RawImage,
    RawModel,
    RawPoints,
    camera_table,
    image_columns,
    order_of_points,
)
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.loaders.errors import Position
from sfm_audit.loaders.model_format import ModelFormat
from sfm_audit.loaders.paths.text_lines import parse_floats, parse_uint, read_text

FILE = "model.toy"


def read(folder):
    file = read_text(folder / FILE)
    cameras, images, points, links = [], {}, {}, {}
    for line, record in file.records():
        kind, *fields = record.split()
        if kind == b"C":
            params = parse_floats(file, line, fields[3:], "parameters")
            size = (parse_uint(file, line, token, "a size") for token in fields[1:3])
            cameras.append(RawCamera(int(fields[0]), BY_NAME["SIMPLE_RADIAL"].model_id, *size, tuple(params)))
        elif kind == b"I":
            images[int(fields[0])] = (int(fields[1]), parse_floats(file, line, fields[2:9], "a pose"), fields[9])
        elif kind == b"P":
            points[int(fields[0])] = parse_floats(file, line, fields[1:], "a point")
        elif kind == b"O":
            xy = parse_floats(file, line, fields[1:3], "a 2D point")
            links.setdefault(int(fields[0]), []).append((xy, int(fields[3])))
        else:
            raise file.malformed(line, "C, I, P or O", kind.decode())
    point3d_id = np.array(list(points), dtype=np.uint64)
    no_tracks = np.empty(0, np.uint32)
    return RawModel(
        camera_table(cameras),
        image_columns([_image(image_id, *images[image_id], links.get(image_id, [])) for image_id in images]),
        RawPoints(
            point3d_id,
            np.array(list(points.values())).reshape(-1, 3),
            np.full(len(points), -1.0),
            order_of_points(file.path, point3d_id, lambda row: Position("row", row + 1)),
            np.zeros(len(points), np.int64),
            no_tracks,
            no_tracks,
            has_tracks=False,
        ),
        None,
        None,
    )


def _image(image_id, camera_id, pose, name, links):
    xy = np.array([xy for xy, _ in links]).reshape(-1, 2)
    ids = np.array([point_id for _, point_id in links], dtype=np.uint64)
    return RawImage(image_id, tuple(pose), camera_id, name.decode(), len(links), np.arange(len(links)), xy, ids)


def count_images(folder):
    return sum(record.startswith(b"I ") for _, record in read_text(folder / FILE).records())


TOY = ModelFormat(name="toy", required=(FILE,), read=read, count_images=count_images)
