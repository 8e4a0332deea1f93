import io

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from sfm_audit.reports import figures
from sfm_audit.reports.charts.numbers import evenly
from sfm_audit.reports.figures import CAPTIONS, ResidualError, Residuals

SIZE = (1600.0, 1200.0)
IMAGE_FIGURES = [
    *(figures.residual_vectors, figures.residual_field, figures.radial_profile, figures.standardised_histogram),
    *(figures.qq_plot, figures.scale_comparison),
]


def noise(n=500, sigma=0.5, seed=0, field=None) -> Residuals:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 1, (n, 2)) * SIZE
    residual = rng.normal(0, sigma, (n, 2))
    if field is not None:
        residual += field(xy)
    return Residuals.build(xy, residual, size_px=SIZE)


def saved(figure: Figure) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def title(figure: Figure) -> str:
    return figure.axes[0].get_title(loc="left")


@pytest.mark.parametrize("draw", IMAGE_FIGURES, ids=lambda f: f.__name__)
@pytest.mark.parametrize("n", [0, 1, 2, 30, 5000])
def test_every_figure_draws_any_number_of_inliers(draw, n):
    assert saved(draw(noise(n))).startswith(b"\x89PNG")


@pytest.mark.parametrize("draw", IMAGE_FIGURES, ids=lambda f: f.__name__)
def test_every_figure_draws_residuals_that_are_all_alike(draw):
    xy = np.random.default_rng(0).uniform(0, 100, (60, 2))
    assert saved(draw(Residuals.build(xy, np.zeros((60, 2)))))
    assert saved(draw(Residuals.build(np.ones((60, 2)), np.ones((60, 2)))))


@pytest.mark.parametrize("draw", IMAGE_FIGURES, ids=lambda f: f.__name__)
def test_figures_have_captions_and_leave_matplotlib_as_it_was(draw):
    assert draw.__name__ in CAPTIONS
    with mpl.rc_context({"axes.grid": True, "font.size": 40.0}):
        before = dict(mpl.rcParams)
        figure = draw(noise())
        assert dict(mpl.rcParams) == before
        assert figure.axes[0].xaxis.label.get_fontsize() == 8.0
    assert not mpl.pyplot.get_fignums() if hasattr(mpl, "pyplot") else True


def test_a_lens_that_bends_lifts_the_radial_profile_and_nothing_else():
    """The planted field is c r^3 along the radius: the outermost mean is what was planted there."""

    def bend(xy):
        offset = xy - np.array(SIZE) / 2
        return 1e-9 * offset * (offset**2).sum(axis=1, keepdims=True)

    figure = figures.radial_profile(noise(5000, field=bend))
    radial, tangential = (line for line in figure.axes[0].lines if "mean" in str(line.get_label()))
    x, y = radial.get_data()
    np.testing.assert_allclose(y, 1e-9 * np.asarray(x) ** 3, atol=0.1)
    assert np.abs(tangential.get_ydata()).max() < 0.1


def test_the_field_marks_cells_beyond_noise():
    def half(xy):
        return np.where(xy[:, :1] < SIZE[0] / 2, [0.6, 0.0], [0.0, 0.0])

    marked = title(figures.residual_field(noise(4000, field=half)))
    clean = title(figures.residual_field(noise(4000)))
    counts = [int(text.split("(")[1].split(" of")[0]) for text in (marked, clean)]
    assert counts[0] >= 35  # of the 40 cells of the left half
    assert counts[1] <= 4


def test_normal_residuals_stay_in_the_band_of_the_qq_plot():
    figure = figures.qq_plot(noise(2000))
    band = figure.axes[0].collections[0].get_paths()[0]
    x, y = next(line for line in figure.axes[0].lines if line.get_label() == "residuals").get_data()
    inside = np.mean([band.contains_point(point, radius=1e-9) for point in zip(x, y, strict=True)])
    assert inside > 0.8


def test_the_robust_scale_is_not_moved_by_outliers_and_the_plain_one_is():
    residuals = noise(1000)
    dirty = residuals.residual_px.copy()
    dirty[::20] *= 20
    figure = figures.scale_comparison(Residuals.build(residuals.xy_px, dirty))
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    scales = {
        label.split(" scale, ")[0]: float(label.split(", ")[1].split()[0]) for label in labels if "scale" in label
    }
    assert scales["robust"] == pytest.approx(0.5, rel=0.1)
    assert scales["plain"] > 1.5


@given(st.integers(0, 3000), st.integers(1, 400))
def test_thinning_keeps_order_and_spacing(count, at_most):
    rows = evenly(count, at_most)
    assert len(rows) == min(count, at_most)
    gaps = np.diff(rows)
    assert (gaps > 0).all()
    assert gaps.size == 0 or gaps.max() - gaps.min() <= 1


def test_any_table_with_the_columns_will_do():
    residuals = noise(50)
    columns = {
        "x_px": residuals.xy_px[:, 0],
        "y_px": residuals.xy_px[:, 1],
        "residual_x_px": residuals.residual_px[:, 0],
        "residual_y_px": residuals.residual_px[:, 1],
    }
    for table in (columns, pd.DataFrame(columns)):
        built = Residuals.from_table(table, size_px=SIZE)
        np.testing.assert_array_equal(built.residual_px, residuals.residual_px)
        assert built.sigma_px == residuals.sigma_px
        np.testing.assert_allclose(built.z, residuals.residual_px / residuals.sigma_px)
    some = {**columns, "z_x": np.where(np.arange(50) < 10, np.nan, 1.0), "z_y": np.ones(50)}
    assert len(Residuals.from_table(some).z) == 40


@pytest.mark.parametrize(
    ("xy", "residual", "words"),
    [
        (np.zeros((3, 2)), np.zeros((2, 2)), "3 points but 2 residuals"),
        (np.zeros((3, 3)), np.zeros((3, 2)), r"shape \(n, 2\)"),
        (np.full((3, 2), np.nan), np.zeros((3, 2)), "not finite"),
    ],
)
def test_what_cannot_be_drawn_is_refused(xy, residual, words):
    with pytest.raises(ResidualError, match=words):
        Residuals.build(xy, residual)


def test_a_missing_column_is_named():
    with pytest.raises(ResidualError, match="no column y_px"):
        Residuals.from_table({"x_px": np.zeros(3), "residual_x_px": np.zeros(3)})


def test_run_figures_draw_with_and_without_numbers():
    rng = np.random.default_rng(0)
    verdicts = rng.choice(["accepted", "rejected", "undetermined"], 200)
    images = pd.DataFrame(
        {"noise_model": ["track"] * 200, "ks_p": rng.uniform(size=200), "ks_constant_p": rng.uniform(size=200) ** 5}
    )
    drawn = [
        figures.verdict_bars({"policy full": {"accepted": 3, "rejected": 1}, "nobody": {}}),
        figures.ks_comparison(images),
        figures.ks_comparison(images.assign(ks_p=np.nan, ks_constant_p=np.nan)),
        figures.histogram_by_verdict(rng.lognormal(size=200), verdicts, label="px", log=True, marks={"here": 1.0}),
        figures.histogram_by_verdict(np.full(200, 2.0), verdicts, label="px"),
        figures.histogram_by_verdict(np.full(200, np.nan), verdicts, label="px"),
        figures.noise_comparison(images.ks_p, images.ks_constant_p, names=("a", "b"), label="p"),
        figures.expected_error(rng.uniform(1, 2, (16, 16)), SIZE),
        figures.expected_error(np.full((16, 16), np.nan), SIZE),
        figures.inliers_on_photo(noise(40), np.zeros((60, 80, 3), dtype=np.uint8)),
    ]
    assert all(saved(figure) for figure in drawn)


def test_misfit_groups_says_what_was_not_tested():
    row = {f"misfit_{group}_{what}": None for group in figures.cameras.MISFIT_GROUPS for what in ("px", "p")}
    assert saved(figures.misfit_groups(row))
    figure = figures.misfit_groups({**row, "misfit_radial_px": 0.5, "misfit_radial_p": 1e-9}, tau_px=0.2)
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts.count("not tested") == 5
    assert "0.50" in texts
    assert "matters above 0.2" in texts


def test_colours_differ_in_lightness_for_every_kind_of_colour_vision():
    """Simulated dichromats (Viénot, Brettel and Mollon 1999, protan and deutan) still see them apart."""
    colours = {name: np.array(mpl.colors.to_rgb(hexa)) ** 2.2 for name, hexa in figures.VERDICT_COLOURS.items()}
    protan = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
    deutan = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
    for seen in (np.eye(3), protan, deutan):
        shown = [np.clip(seen @ colour, 0, 1) ** (1 / 2.2) for colour in colours.values()]
        gaps = [np.linalg.norm(a - b) for i, a in enumerate(shown) for b in shown[:i]]
        assert min(gaps) > 0.2
