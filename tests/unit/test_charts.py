"""Charts written as SVG: what is drawn is where the numbers say, at any number, and texts are texts."""

import math
import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_audit.reports.charts import Residuals, cameras, normality, runs, sensor
from sfm_audit.reports.charts.canvas import Axis, Chart, arrow_path
from sfm_audit.reports.charts.numbers import cell_means, log_ticks, tick_label, ticks
from sfm_audit.reports.charts.scene import SceneView, place, principal_axes, side_view, strongest_pairs, top_view

SIZE = (1600.0, 1200.0)
VERDICTS = ("accepted", "rejected", "undetermined")
IMAGE_CHARTS = [
    *(sensor.residual_vectors, sensor.residual_field, sensor.radial_profile),
    *(normality.standardised_histogram, normality.qq_plot, normality.scale_comparison),
]


def noise(n, sigma=0.5, seed=0):
    rng = np.random.default_rng(seed)
    return Residuals.build(rng.uniform(0, 1, (n, 2)) * SIZE, rng.normal(0, sigma, (n, 2)), size_px=SIZE)


def parsed(svg):
    """The picture as XML: it is well formed, has a label, and no number in it is not finite."""
    root = ET.fromstring(str(svg))  # noqa: S314 - our own
    assert root.get("role") == "img"
    assert root.get("aria-label")
    drawn = " ".join(value for element in root.iter() for name, value in element.items() if name in {"d", "x", "y"})
    assert not re.search(r"nan|inf", drawn)
    return root


def texts(root):
    return [element.text or "" for element in root.iter() if element.tag.endswith("text")]


@pytest.mark.parametrize("draw", IMAGE_CHARTS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("n", [0, 1, 30, 5000])
@pytest.mark.parametrize("sigma", [0.0, 0.5, 1e150])
def test_every_chart_draws_any_number_of_inliers(draw, n, sigma):
    parsed(draw(noise(n, sigma)))


@pytest.mark.parametrize("value", [1e-14, 1e-300, 1.0, 1e300])
@pytest.mark.parametrize("log", [True, False])
@pytest.mark.parametrize("n", [1, 3])
def test_a_histogram_of_a_single_value_keeps_its_ticks(value, log, n):
    svg = runs.histogram_by_verdict([value] * n, ["rejected"] * n, label="misfit, px", caption="c", log=log)
    root = parsed(svg)
    ticked = [element.text for element in root.iter() if element.get("class") == "tick"]
    assert len([text for text in ticked if text != "0"]) >= 2


@given(st.floats(-1e12, 1e12), st.floats(1e-9, 1e12))
def test_ticks_are_round_inside_and_never_many(low, width):
    high = low + width
    found = ticks(low, high)
    if width < 1e-9 * abs(low):
        return
    assert 2 <= len(found) <= 8
    assert all(low - 1e-6 * width <= value <= high + 1e-6 * width for value in found)
    assert found == sorted(set(found))


@given(st.floats(-300, 290), st.floats(0.01, 12))
def test_ticks_of_decades(exponent, decades):
    low, high = 10.0**exponent, 10.0 ** (exponent + decades)
    found = log_ticks(low, high)
    assert 2 <= len(found) <= 8
    assert all(low * (1 - 1e-6) <= value <= high * (1 + 1e-6) for value in found)


@pytest.mark.parametrize(
    ("value", "words"), [(0.0, "0"), (-5.0, "\u22125"), (1e-14, "1e-14"), (0.25, "0.25"), (1e6, "1e6"), (2e-7, "2e-7")]
)
def test_numbers_on_axes(value, words):
    assert tick_label(value) == words


def test_a_chart_places_what_it_draws_where_its_axes_say():
    chart = Chart(Axis(0.0, 10.0), Axis(1.0, 100.0, log=True), size=(300.0, 200.0))
    at = chart.place([0.0, 5.0, 10.0], [1.0, 10.0, 100.0])
    np.testing.assert_allclose(at[1], (at[0] + at[2]) / 2)
    assert at[0, 1] > at[2, 1]  # upwards
    assert np.isfinite(chart.place([np.nan, np.inf], [np.nan, -1.0])).all()


def test_what_is_out_of_all_bounds_stands_far_away_without_a_warning():
    chart = Chart(Axis(0.0, 1.0), Axis(0.0, 1.0))
    places = chart.place(np.array([0.0, 1e307, np.nan]), np.array([0.0, -1e307, np.inf]))
    assert np.isfinite(places).all()


def test_arrows_end_where_they_should():
    d = arrow_path(np.array([[0.0, 0.0]]), np.array([[30.0, 0.0]]), 3.0)
    assert d.startswith("M0.0 0.0L30.0 0.0M")
    assert d.endswith("L30.0 0.0 27.0 1.5")


def test_arrows_of_the_field_show_the_planted_mean_at_its_magnification():
    """A constant residual of (0.3, -0.1) px: each cell's arrow is that vector times the magnification it names."""
    xy = np.random.default_rng(1).uniform(0, 1, (4000, 2)) * SIZE
    svg = sensor.residual_field(Residuals.build(xy, np.tile([0.3, -0.1], (4000, 1)), size_px=SIZE))
    root = parsed(svg)
    factor = float(re.search(r"\u00d7 ([0-9.]+)", " ".join(texts(root)))[1])
    arrows = next(e.get("d") for e in root.iter() if (e.get("class") or "").startswith("arrow vermilion"))
    drawn = np.array(re.findall(r"M([\d.-]+) ([\d.-]+)L([\d.-]+) ([\d.-]+)M", arrows), dtype=float)
    box = next(e for e in root if e.tag.endswith("svg"))
    scale = float(box.get("width")) / SIZE[0]
    assert len(drawn) >= 70
    expected = np.array([0.3, -0.1]) * factor * scale
    np.testing.assert_allclose(np.median(drawn[:, 2:] - drawn[:, :2], axis=0), expected, atol=0.15)


def test_cell_means_are_means():
    residuals = noise(3000)
    means = cell_means(residuals, cells=8)
    cell = (residuals.xy_px // means.side_px).astype(int) @ [1, means.shape[1]]
    for k in np.flatnonzero(means.full)[::7]:
        np.testing.assert_allclose(means.mean_px[k], residuals.residual_px[cell == k].mean(axis=0))


def test_verdicts_differ_by_more_than_colour_and_counts_are_said():
    counts = {"policy <x>": {"accepted": 30, "rejected": 9, "undetermined": 1}}
    root = parsed(runs.verdict_bars(counts, "verdicts"))
    assert {"policy <x>", "30", "9"} <= set(texts(root))
    widths = [float(e.get("width")) for e in root.iter() if e.get("class") in {f"bar {v}" for v in VERDICTS}][3:]
    np.testing.assert_allclose(np.array(widths) / sum(widths), [30 / 40, 9 / 40, 1 / 40], atol=2e-3)


def test_a_histogram_holds_every_image():
    values = np.concatenate([np.geomspace(0.01, 10, 60), [1e6, np.nan, -1.0]])
    verdicts = [VERDICTS[i % 3] for i in range(63)]
    root = parsed(runs.histogram_by_verdict(values, verdicts, label="x", caption="c", log=True, marks={"tau": 0.2}))
    assert {"61 images, 2 without the number", "tau"} <= set(texts(root))


def test_noise_and_ks_over_a_run():
    p = np.linspace(0, 1, 1001)
    root = parsed(runs.ks_comparison(p**2, p, noise="track", alpha=0.05, caption="c"))
    assert {"track noise: 5 % at 0.05", "constant noise: 22 % at 0.05"} <= set(texts(root))
    both = {"names": ("a", "b"), "label": "x", "caption": "c"}
    assert "a: median 0.5" in texts(parsed(runs.noise_comparison(p, [math.nan], **both)))
    assert "x: none computed" in texts(parsed(runs.noise_comparison([], [math.nan], **both)))
    nothing = runs.ks_comparison([], [], noise=None, alpha=0.05, caption="c")
    assert "KS was not computed" in texts(parsed(nothing))


def test_misfit_groups_say_what_was_not_tested():
    row = {f"misfit_{group}_{k}": None for group in sensor_groups() for k in ("px", "p", "rank")}
    row |= {"misfit_radial_px": 0.6, "misfit_radial_p": 1e-9, "misfit_affine_rank": 0}
    root = parsed(cameras.misfit_groups(row, tau_px=0.2, alpha=0.05, label="g"))
    said = texts(root)
    assert {"0.60", "the model has it", "not tested", "matters above 0.2"} <= set(said)
    row["misfit_radial_px"] = 1e200
    assert "no group could be tested" in texts(parsed(cameras.misfit_groups(row, tau_px=None, alpha=0.05, label="g")))


def sensor_groups():
    return ("radial", "tangential", "affine", "principal_point", "rolling_shutter", "smooth")


def test_correlations_stand_below_the_diagonal():
    root = parsed(cameras.correlations(["fx", "<fy>", "k1"], [0.5, -0.25, None], label="c"))
    assert [text for text in texts(root) if text] == ["<fy>", "+0.50", "k1", "\u22120.25", "-", "fx", "<fy>"]
    assert "fewer than two" in texts(parsed(cameras.correlations(["f"], [], label="c")))[0]


def ring(n=24, rotation=None):
    """Cameras on a circle in a plane, looking inwards, upright, and points in the middle."""
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    centre = np.column_stack([5 * np.cos(angle), 3 * np.sin(angle), np.zeros(n)])
    ahead = -centre / np.linalg.norm(centre, axis=1, keepdims=True)
    points = np.random.default_rng(0).normal(0, 0.4, (200, 3))
    pairs = np.column_stack([np.arange(n - 1), np.arange(1, n)])
    turn = np.eye(3) if rotation is None else rotation
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    return SceneView(
        np.arange(n), centre @ turn.T, ahead @ turn.T, up @ turn.T, points @ turn.T, pairs, 100 - pairs[:, 0]
    )


def turned(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("seed", range(4))
def test_the_views_do_not_depend_on_the_frame_of_the_world(seed):
    """The axes are the cloud's: lengths on paper stay the same to a pixel when the world is turned, and up stays up."""
    one, two = place(ring()), place(ring(rotation=turned(seed)))
    axes = principal_axes(ring(rotation=turned(seed)))
    np.testing.assert_allclose(axes @ turned(seed) @ [0, 0, 1], [0, 0, 1], atol=0.1)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    for a, b in ((one.top, two.top), (one.side, two.side)):
        np.testing.assert_allclose(
            np.linalg.norm(a[:12] - a[12:], axis=1), np.linalg.norm(b[:12] - b[12:], axis=1), rtol=1e-6
        )


def test_top_and_side_view_share_the_horizontal_axis_and_hold_all_cameras():
    view = ring()
    placed = place(view)
    np.testing.assert_allclose(placed.top[:, 0], placed.side[:, 0])
    assert np.ptp(placed.side[:, 1]) < 0.2 * np.ptp(placed.top[:, 1])  # the ring lies flat
    verdicts = ["rejected", "accepted", None, *["undetermined"] * 21]
    root = parsed(top_view(placed, verdicts, strongest_pairs(view, 2), "top"))
    drawn = {e.get("class"): (e.get("d") or "").count("Z") for e in root.iter() if "wedge" in (e.get("class") or "")}
    assert drawn == {"wedge rejected": 1, "wedge accepted": 1, "wedge other": 1, "wedge undetermined": 21}
    parsed(side_view(placed, verdicts, "side"))


def test_a_camera_far_off_and_one_that_stands_nowhere_do_not_shrink_the_scene():
    view = ring()
    centre = view.centre.copy()
    centre[0], centre[1] = [1e6, 0, 0], [np.nan] * 3
    placed = place(SceneView(view.image_id, centre, view.ahead, view.up, view.points, view.pairs, view.shared))
    assert placed.outside.tolist() == [True, True, *[False] * 22]
    assert np.ptp(placed.top[2:, 0]) > 300
    parsed(top_view(placed, [None] * 24, view.pairs, "top"))


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_scene_of_few_cameras(n):
    empty = np.zeros((0, 2), dtype=np.int64)
    view = SceneView(np.arange(n), *(np.ones((n, 3)) for _ in range(3)), np.zeros((0, 3)), empty, empty[:, 0])
    placed = place(view)
    parsed(top_view(placed, ["accepted"] * n, empty, "top"))


def test_the_strongest_pairs_are_the_strongest_of_either_image():
    pairs, shared = np.array([[0, 1], [0, 2], [1, 2], [2, 3]]), np.array([9, 5, 1, 2])
    view = SceneView(np.arange(4), *(np.zeros((4, 3)) for _ in range(4)), pairs, shared)
    assert strongest_pairs(view, 1).tolist() == [[0, 1], [0, 2], [2, 3]]
    assert strongest_pairs(view, 3).tolist() == pairs.tolist()


def test_places_whose_squares_are_not_finite_are_not_drawn():
    view = ring()
    points, centre = view.points.copy(), view.centre.copy()
    points[3, 1], centre[2, 0] = 1e300, -1.7e308
    odd = SceneView(view.image_id, centre, view.ahead, view.up, points, view.pairs, view.shared)
    placed = place(odd)
    assert len(placed.points_top) < len(view.points)
    assert np.isnan(placed.top[2]).all()
    assert np.isfinite(np.delete(placed.top, 2, axis=0)).all()
