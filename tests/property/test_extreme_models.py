"""Models with extreme but finite numbers through loader, audit, tables and page: nothing but words comes out."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from hypothesis import given, settings
from hypothesis import strategies as st
from model_writer import noisy_model, write_binary

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.table.words import Verdict

NUM_IMAGES, NUM_POINTS = 5, 40
EXTREMES = st.one_of(
    st.sampled_from([0.0, -1.0, 5e-324, 1e-310, 1e-30, 1e-6, 1e6, 1e12, 1e13, 1e30, 1e100, 1e155, 1e300, 1.7e308]),
    st.floats(allow_nan=False, allow_infinity=False),
)
SIGNS = st.sampled_from([1.0, -1.0])


@st.composite
def extreme_models(draw):
    """A sound model of which one to six numbers are replaced by extreme ones, anywhere but in ids and links."""
    model = noisy_model(seed=3, num_images=NUM_IMAGES, num_points=NUM_POINTS)
    cameras, images, points = list(model.cameras), list(model.images), list(model.points)
    for _ in range(draw(st.integers(1, 6))):
        value = draw(EXTREMES) * draw(SIGNS)
        kind = draw(st.sampled_from(["param", "pose", "xy", "xyz", "all_xyz", "error"]))
        place, axis = draw(st.integers(0, 10**6)), draw(st.integers(0, 10**6))
        if kind == "param":
            k = place % len(cameras)
            cameras[k] = replace(cameras[k], params=put(cameras[k].params, axis, value))
        elif kind == "pose":
            k = place % len(images)
            images[k] = replace(images[k], pose=put(images[k].pose, axis, value))
        elif kind == "xy":
            k = place % len(images)
            seen = list(images[k].points2d)
            which = axis % len(seen)
            seen[which] = (*put(seen[which][:2], axis, value), *seen[which][2:])
            images[k] = replace(images[k], points2d=tuple(seen))
        elif kind == "all_xyz":
            points = [replace(point, xyz=put(point.xyz, axis, value)) for point in points]
        else:
            k = place % len(points)
            changes = {"error": value} if kind == "error" else {"xyz": put(points[k].xyz, axis, value)}
            points[k] = replace(points[k], **changes)
    return model.but(cameras=tuple(cameras), images=tuple(images), points=tuple(points))


def put(values, place, value):
    """Return the values with one of them replaced."""
    out = list(values)
    out[place % len(out)] = value
    return tuple(out)


@given(model=extreme_models())
@settings(max_examples=20, deadline=None)
def test_extreme_numbers_reach_the_tables_and_the_page_as_words(model):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_binary(folder / "model", model)
        run = folder / "RUN"
        assert main(["run", str(folder / "model"), "-o", str(run), "--quiet", "--jobs", "1"]) == 0
        (part,) = (run / "images").glob("*.parquet")
        table = pq.read_table(part)
        assert table.num_rows == NUM_IMAGES
        assert set(table["verdict"].to_pylist()) <= set(Verdict)
        for column in (table[name] for name in table.column_names):
            if str(column.type) == "double":
                assert np.isfinite(column.drop_null().to_numpy()).all()
        assert json.loads((run / "run.json").read_text(encoding="utf-8"))["failures"] == []
        assert main(["report", str(run), "-o", str(folder / "page.html"), "--quiet"]) == 0
        assert (folder / "page.html").stat().st_size > 10_000
