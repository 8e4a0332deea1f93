"""sfm-audit report and run --observations as a user meets them."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from run_samples import part_times, write_models

from sfm_audit.audit.cli.main import main
from sfm_audit.reports.figures import ResidualError, read_residuals


@pytest.fixture(scope="session")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "data"
    write_models(folder, ("0001", "0002"), num_points=200)
    return folder


@pytest.fixture(autouse=True)
def _data(source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(source, tmp_path / "data")


def run(*more: str) -> None:
    assert main(["run", "data", "-o", "RUN", "--quiet", *more]) == 0


def excess_kurtosis(z) -> float:
    values = z.to_numpy()[~np.isnan(z.to_numpy())]
    return float(((values - values.mean()) ** 4).mean() / values.var() ** 2 - 3)


def test_observations_are_one_row_per_inlier():
    run("--observations")
    images, rows = pd.read_parquet("RUN/images"), pd.read_parquet("RUN/observations")
    assert len(rows) == images["num_inliers"].sum()
    keys = ["scene", "image_id"]
    by_image = rows.astype({"scene": str}).groupby(keys)
    rms = by_image[["residual_x_px", "residual_y_px"]].apply(lambda r: np.sqrt((r.to_numpy() ** 2).sum(axis=1).mean()))
    wanted = images.set_index(keys)
    np.testing.assert_allclose(rms, wanted["rms_px"].reindex(rms.index))
    standardised = by_image["z_x"].count()
    np.testing.assert_array_equal(standardised, wanted["num_standardised"].reindex(standardised.index))
    kurtosis = by_image[["z_x", "z_y"]].apply(excess_kurtosis)
    np.testing.assert_allclose(kurtosis, wanted["kurtosis_excess"].reindex(kurtosis.index), rtol=1e-6)
    assert set(rows["image_name"]) == set(images["image_name"])
    assert str(rows["image_name"].dtype) == "category"


@pytest.mark.parametrize("noise", ["constant", "track"])
def test_the_z_of_an_observation_is_that_of_its_noise_model(noise):
    run("--observations", "--noise", noise)
    images, rows = pd.read_parquet("RUN/images"), pd.read_parquet("RUN/observations")
    assert rows["z_x"].count() == images["num_standardised"].sum()
    if noise == "constant":
        sigma = images.set_index(["scene", "image_id"])["sigma_constant_px"]
        own = sigma.loc[list(zip(rows["scene"].astype(str), rows["image_id"], strict=True))]
        np.testing.assert_allclose(rows["z_x"], rows["residual_x_px"] / own.to_numpy())


def test_without_the_option_there_are_none_and_asking_later_adds_them():
    run()
    assert not Path("RUN/observations").exists()
    before = pd.read_parquet("RUN/images")
    run("--observations")
    assert len(list(Path("RUN/observations").glob("part-*.parquet"))) == 2
    pd.testing.assert_frame_equal(pd.read_parquet("RUN/images"), before)
    times = part_times(Path("RUN"))
    run("--observations")
    run()
    assert part_times(Path("RUN")) == times


def test_a_model_that_changes_takes_its_observations_along():
    run("--observations")
    shutil.rmtree("data/0001")
    shutil.copytree("data/0002", "data/0001")
    run()
    assert len(list(Path("RUN/observations").glob("part-*.parquet"))) == 1


@pytest.mark.parametrize("observations", [True, False])
def test_a_report_of_a_run(capsys, observations):
    run(*["--observations"] if observations else [])
    if observations:
        shutil.rmtree("data")
    assert main(["report", "RUN", "--worst", "2", "-o", "out/page.html"]) == 0
    out, err = capsys.readouterr()
    assert "10 images, pictures of 2" in out
    assert err == ""
    text = Path("out/page.html").read_text(encoding="utf-8")
    assert text.count('id="worst-') == 2
    assert "Q-Q plot" in text
    assert "The same residuals under the robust" in text


def test_the_recomputed_pictures_are_those_of_the_observations():
    run()
    assert main(["report", "RUN", "--worst", "1", "-o", "a.html", "--quiet"]) == 0
    run("--observations")
    assert main(["report", "RUN", "--worst", "1", "-o", "b.html", "--quiet"]) == 0
    pages = [
        re.sub(r'<dl class="run">.*?</dl>', "", Path(name).read_text(), flags=re.DOTALL)
        for name in ("a.html", "b.html")
    ]
    assert pages[0] == pages[1]  # but for when, and by which command


def test_photos_show_the_inliers():
    run("--observations")
    for scene in ("0001", "0002"):
        for image_name in pd.read_parquet("RUN/images")["image_name"]:
            path = Path("photos", scene, "images", image_name)
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (64, 48)).save(path, format="png")
    assert main(["report", "RUN", "--worst", "1", "--images", "photos", "-o", "p.html", "--quiet"]) == 0
    assert "data:image/jpeg;base64," in Path("p.html").read_text()


@pytest.mark.parametrize("change", ["gone", "changed"])
def test_a_model_that_is_not_there_any_more_is_said(change):
    run()
    if change == "gone":
        shutil.rmtree("data")
    else:
        for scene in ("0001", "0002"):
            with Path("data", scene, "sparse", "0", "cameras.bin").open("ab") as file:
                file.write(b"x")
    assert main(["report", "RUN", "-o", "page.html", "--quiet"]) == 0
    text = Path("page.html").read_text()
    assert "No pictures" in text
    assert "--observations" in text


def test_exit_codes(capsys):
    run()
    assert main(["report", "nowhere"]) == 3
    assert main(["report", "RUN", "--images", "nowhere"]) == 2
    Path("page.html").write_text("mine")
    assert main(["report", "RUN", "-o", "page.html"]) == 2
    assert Path("page.html").read_text() == "mine"
    assert main(["report", "RUN", "-o", "page.html", "--worst", "0", "--force"]) == 0
    Path("file").touch()
    assert main(["report", "RUN", "-o", "file/page.html", "--worst", "0"]) == 4
    part = next(Path("RUN/images").iterdir())
    part.write_bytes(b"no parquet")
    assert main(["report", "RUN", "-o", "other.html"]) == 3
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 5
    assert all(line.startswith("sfm-audit: ") for line in err)


def test_a_run_that_was_not_finished_is_shown_and_said():
    run()
    path = Path("RUN/run.json")
    info = json.loads(path.read_text())
    kept = {name: info[name] for name in ("tool", "version", "config", "paths")}
    path.write_text(json.dumps({**kept, "status": "running"}))
    assert main(["report", "RUN", "-o", "page.html", "--quiet", "--worst", "1"]) == 0
    text = Path("page.html").read_text()
    assert "This run was not finished" in text
    assert "Q-Q plot" in text
    path.write_text("[]")
    assert main(["report", "RUN", "-o", "other.html"]) == 3


def test_a_missing_library_names_the_extra(capsys, monkeypatch):
    run()
    monkeypatch.setitem(__import__("sys").modules, "sfm_audit.audit.cli.report_page", None)
    assert main(["report", "RUN", "-o", "page.html"]) == 2
    assert 'pip install "sfm-audit[report]"' in capsys.readouterr().err


def test_figures_of_a_run_from_a_notebook():
    run("--observations")
    images = pd.read_parquet("RUN/images")
    row = images[images["scene"] == "0001"].iloc[0]
    residuals = read_residuals("RUN", row["image_name"], scene="0001")
    assert len(residuals) == row["num_inliers"]
    assert residuals.sigma_px == row["sigma_constant_px"]
    assert residuals.size_px == (row["width"], row["height"])
    with pytest.raises(ResidualError, match="2 images"):
        read_residuals("RUN", row["image_name"])
    with pytest.raises(ResidualError, match="no image"):
        read_residuals("RUN", "nothing")
    by_id = read_residuals("RUN", f"id:{row['image_id']}", scene="0001")
    np.testing.assert_array_equal(by_id.residual_px, residuals.residual_px)
