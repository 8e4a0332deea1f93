"""The same table whichever ran it: serial, two processes, two Dask workers on this machine."""

import pytest
from run_samples import read_run, run_cli

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.simulate.dataset import DatasetSpec, write_dataset

SCHEDULES = {"processes": ("--jobs", "2"), "dask": ("--jobs", "2", "--dask", "local")}


@pytest.fixture(scope="module")
def twenty(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated") / "MegaDepth_v1_SfM"
    write_dataset(folder, DatasetSpec(20, 10, spread=0.3, linked=(120, 250), keypoints=400, defects=0.1), 1)
    return folder


@pytest.fixture(scope="module")
def serial_twenty(twenty):
    assert main(["run", str(twenty), "-o", str(twenty.parent / "serial"), "--jobs", "1", "--quiet"]) == 0
    return read_run(twenty.parent / "serial")


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_twenty_simulated_scenes(twenty, serial_twenty, schedule):
    if schedule == "dask":
        pytest.importorskip("distributed")
    run = twenty.parent / schedule
    assert run_cli("run", twenty, "-o", run, *SCHEDULES[schedule], "--quiet") == (0, "", "")
    check_equal(read_run(run), serial_twenty)
    assert len(serial_twenty["models"]) == 20


@pytest.mark.corpus
def test_the_corpus(corpus, tmp_path):
    data = corpus / "megadepth_like"
    assert main(["run", str(data), "-o", str(tmp_path / "serial"), "--jobs", "1", "--quiet"]) == 0
    for name, options in SCHEDULES.items():
        if name == "dask":
            pytest.importorskip("distributed")
        assert run_cli("run", data, "-o", tmp_path / name, *options, "--quiet") == (0, "", "")
        check_equal(read_run(tmp_path / name), read_run(tmp_path / "serial"))


def check_equal(one, other):
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].equals(other[name]), name
