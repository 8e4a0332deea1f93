"""sfm-audit run as a user meets it: exit codes, what is printed where, and what lies in the run folder afterwards."""

import json
import os
import resource
import signal
from pathlib import Path

import pandas as pd
import pytest
from audit_stubs import SECONDS
from run_samples import copy_models, part_times, read_run, run_cli, start_cli, truncate, wait_for, write_models

from sfm_audit.audit.cli.main import main

pytestmark = pytest.mark.usefixtures("data")
NAMES = ("0001", "0002", "a name with spaces", "Zürich 東")


@pytest.fixture(scope="session")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("source") / "data"
    write_models(folder, NAMES)
    return folder


@pytest.fixture
def data(source, tmp_path, monkeypatch):
    """Four models below data/, the working folder's."""
    monkeypatch.chdir(tmp_path)
    return copy_models(source, tmp_path / "data")


def same_rows(first: Path, second: Path) -> bool:
    one, two = read_run(first), read_run(second)
    return all(one[name].equals(two[name]) for name in ("images", "cameras", "models"))


def parts(run: str, table: str = "models") -> list[Path]:
    return list(Path(run, table).glob("part-*.parquet"))


def test_a_run_writes_one_row_per_image_and_model(capsys):
    assert main(["run", "data", "-o", "RUN"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "4 models" in out
    images, models = pd.read_parquet("RUN/images"), pd.read_parquet("RUN/models")
    cameras = pd.read_parquet("RUN/cameras")
    assert len(images) == 20
    assert cameras.groupby("model_path")["num_images"].sum().tolist() == [5] * 4
    assert sorted(models["scene"]) == sorted(NAMES)
    assert set(models["dataset"]) == {"data"}
    assert set(models["component"]) == {"0"}
    assert "data/a name with spaces/sparse/0" in set(models["model_path"])
    assert (models["num_accepted"] + models["num_rejected"] + models["num_undetermined"] == 5).all()
    assert set(images["verdict"]) <= {"accepted", "rejected", "undetermined"}


def test_quiet_prints_nothing(capsys):
    assert main(["run", "data/0001", "-o", "RUN", "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_a_piped_summary_is_plain_and_80_columns_wide():
    code, out, err = run_cli("run", "data", "-o", "RUN")
    assert (code, err) == (0, "")
    assert "\x1b" not in out
    assert max(len(line) for line in out.splitlines()) <= 80


def test_a_reader_that_leaves_is_no_error():
    with start_cli("run", "data", "-o", "RUN") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 0
    assert len(parts("RUN")) == 4


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_broken_model_costs_one_line_and_3_and_the_others_are_there(data, jobs, capsys):
    truncate(data / "0002/sparse/0/points3D.bin")
    assert main(["run", "data", "-o", "RUN", "--jobs", jobs]) == 3
    out, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert "data/0002/sparse/0/points3D.bin" in err
    assert "Not audited" in out
    assert sorted(pd.read_parquet("RUN/models")["scene"]) == sorted(set(NAMES) - {"0002"})
    failures = json.loads(Path("RUN/run.json").read_text(encoding="utf-8"))["failures"]
    assert [failure["location"] for failure in failures] == ["data/0002/sparse/0"]


def test_a_path_that_is_not_there_costs_one_line_and_3(capsys):
    assert main(["run", "data/0001", "nothing", "-o", "RUN"]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "nothing" in err
    assert len(pd.read_parquet("RUN/models")) == 1
    assert main(["run", "data/0001", "-o", "RUN", "--quiet"]) == 0, "the folder is not bound to what held no model"


def test_a_typo_leaves_no_folder_behind(capsys):
    assert main(["run", "daat", "-o", "RUN"]) == 3
    assert capsys.readouterr().out == ""
    assert not Path("RUN").exists()


def test_wrong_config_and_wrong_folder_are_2(capsys):
    Path("bad.toml").write_text("alhpa = 1", encoding="utf-8")
    Path("full").mkdir()
    Path("full/thesis.tex").touch()
    for args in (["-o", "RUN", "--config", "bad.toml"], ["-o", "full"]):
        assert main(["run", "data", *args]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not Path("RUN").exists()
    assert [path.name for path in Path("full").iterdir()] == ["thesis.tex"]


def test_another_config_in_the_same_folder_is_2_and_changes_nothing(capsys):
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    before = part_times(Path("RUN"))
    assert main(["run", "data", "-o", "RUN", "--noise", "constant"]) == 2
    assert "noise = track, not constant" in capsys.readouterr().err
    assert part_times(Path("RUN")) == before


def test_config_file_and_options_reach_the_tables():
    Path("audit.toml").write_text('noise = "constant"\nmin_observations = 100000\n', encoding="utf-8")
    assert main(["run", "data/0001", "-o", "RUN", "--config", "audit.toml", "--quiet"]) == 0
    images = pd.read_parquet("RUN/images")
    assert set(images["noise_model"]) == {"constant"}
    assert set(images["verdict"]) == {"undetermined"}
    assert main(["run", "data/0001", "-o", "RUN2", "--config", "audit.toml", "--noise", "track", "--quiet"]) == 0
    assert set(pd.read_parquet("RUN2/images")["noise_model"]) == {"track"}


def config_of(run: str) -> dict:
    return json.loads(Path(run, "run.json").read_text(encoding="utf-8"))["config"]


def test_min_effect_in_sigma_is_each_image_s_own():
    """The noise is 0.5 px and the cameras are right: with a tau next to nothing, the significant ones alone decide."""
    tables = {}
    for tau in ("0.2px", "0.5sigma", "0.0001sigma"):
        assert main(["run", "data", "-o", tau, "--min-effect", tau, "--quiet"]) == 0
        assert config_of(tau)["min_effect"] == tau
        tables[tau] = pd.read_parquet(f"{tau}/images")
    for tau, frame in tables.items():
        limit = 0.2 if tau == "0.2px" else float(tau.removesuffix("sigma")) * frame["sigma_constant_px"]
        judged = frame["verdict_misfit"] != "undetermined"
        expected = frame["misfit_px"].notna() & (frame["misfit_px"] > limit)
        assert ((frame["verdict_misfit"] == "rejected") == (expected & judged)).all()


def test_independent_points_are_not_whitened_and_nobody_is_blamed():
    args = ("--points", "independent", "--noise", "constant")
    assert main(["run", "data", "-o", "RUN", *args, "--quiet"]) == 0
    assert {config_of("RUN")[name] for name in ("points", "noise")} == {"independent", "constant"}
    images = pd.read_parquet("RUN/images")
    assert set(images["noise_model"]) == {"constant"}
    assert (images["num_unverifiable"] == 0).all()
    assert images["verdict_misfit"].notna().all()
    assert main(["run", "data", "-o", "OTHER", "--points", "independent"]) == 2


@pytest.mark.parametrize("policy", ["paper", "camera", "full"])
def test_a_policy_is_what_its_members_say(policy):
    members = {"paper": ["verdict_ks"], "camera": ["verdict_misfit", "verdict_pose", "plausible"]}
    members["full"] = [*members["paper"], *members["camera"]]
    Path("audit.toml").write_text("alpha = 0.3\n", encoding="utf-8")  # a level at which something is rejected
    assert main(["run", "data", "-o", "RUN", "--policy", policy, "--config", "audit.toml", "--quiet"]) == 0
    images = pd.read_parquet("RUN/images")
    for _, row in images.iterrows():
        said = set(row[members[policy]])
        wanted = next(verdict for verdict in ("rejected", "undetermined", "accepted") if verdict in said)
        assert row["verdict"] == wanted
        assert wanted == "accepted" or len(row["reasons"])


def test_keypoint_noise_without_a_database_costs_one_line_and_3(capsys):
    assert main(["run", "data/0001", "-o", "RUN", "--noise", "keypoint"]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "data/0001/sparse/0" in err
    assert "database.db" in err
    assert "use --noise track" in err


def test_keypoint_noise_on_real_models(corpus, capsys):
    root = corpus / "megadepth_like" / "MegaDepth_v1_SfM"
    for noise in ("keypoint", "track"):
        assert main(["run", str(root), "-o", noise, "--noise", noise, "--jobs", "1"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    # a command to copy holds the model's location in one piece, however long that is
    assert max(len(line) for line in out.splitlines() if str(root) not in line) <= 80
    keypoint, track = pd.read_parquet("keypoint/images"), pd.read_parquet("track/images")
    assert set(keypoint["noise_model"]) == {"keypoint"}
    assert sorted(keypoint["image_name"]) == sorted(track["image_name"])
    same = ["scene", "component", "image_id", "num_inliers", "rms_px", "verdict_misfit", "verdict_pose", "plausible"]
    pd.testing.assert_frame_equal(keypoint[same], track[same])
    assert not keypoint["sigma_predicted_px"].equals(track["sigma_predicted_px"])


@pytest.mark.parametrize("out", ["file", "file/RUN", "/proc/RUN"])
def test_output_that_cannot_be_written_is_4(out, capsys):
    Path("file").touch()
    assert main(["run", "data", "-o", out]) == 4
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert "cannot be written" in captured.err
    assert ("it is a file, and a run is a folder" in captured.err) == (out == "file")


def test_a_disk_that_fills_up_is_4_and_finished_parts_stay():
    assert main(["run", "data/0001", "-o", "RUN", "--quiet"]) == 0
    before = part_times(Path("RUN"))
    code, _, err = run_cli(
        *("run", "data/0001", "data", "-o", "RUN"),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),
    )
    assert (code, err.count("\n")) == (4, 1)
    assert part_times(Path("RUN")) == before
    assert not list(Path("RUN").rglob(".tmp-*"))
    assert main(["run", "data/0001", "data", "-o", "RUN", "--quiet"]) == 0
    assert len(parts("RUN")) == 4


def test_processes_give_the_tables_of_one_process():
    assert main(["run", "data", "-o", "ONE", "--jobs", "1", "--quiet"]) == 0
    assert main(["run", "data", "-o", "TWO", "--jobs", "2", "--quiet"]) == 0
    assert same_rows(Path("ONE"), Path("TWO"))


def test_a_second_run_audits_only_what_changed(data):
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    before = part_times(Path("RUN"))
    (data / "0001/sparse/0/images.bin").touch()  # touched, not changed
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    assert part_times(Path("RUN")) == before
    write_models(data, ["new"], seed=77)
    for file in (data / "new/sparse/0").iterdir():
        file.replace(data / "0002/sparse/0" / file.name)
    (data / "new/sparse/0").rmdir()
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    changed = {name for name, time in part_times(Path("RUN")).items() if before[name] != time}
    assert len(changed) == 3
    assert main(["run", "data", "-o", "FRESH", "--quiet"]) == 0
    assert same_rows(Path("RUN"), Path("FRESH"))


def test_a_model_that_breaks_loses_its_rows_and_gets_them_back(data):
    file = data / "0001/sparse/0/points3D.bin"
    content = file.read_bytes()
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    truncate(file)
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 3
    assert "0001" not in set(pd.read_parquet("RUN/images")["scene"])
    file.write_bytes(content)
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    assert "0001" in set(pd.read_parquet("RUN/images")["scene"])


def test_a_path_that_is_away_for_a_while_keeps_its_rows(data):
    assert main(["run", "data/0001", "data/0002", "-o", "RUN", "--quiet"]) == 0
    away = (data / "0002").rename(data / "away")
    assert main(["run", "data/0001", "data/0002", "-o", "RUN", "--quiet"]) == 3
    assert len(parts("RUN")) == 2
    away.rename(data / "0002")
    assert main(["run", "data/0001", "data/0002", "-o", "RUN", "--quiet"]) == 0


def test_a_model_that_is_gone_from_its_path_loses_its_rows(data):
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    (data / "0002").rename(data.parent / "elsewhere")
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    assert "0002" not in set(pd.read_parquet("RUN/images")["scene"])


def test_a_killed_run_goes_on_and_leaves_no_process_behind():
    with start_cli("run", "data", "-o", "RUN", "--jobs", "2", stub="slow") as process:
        wait_for(lambda: parts("RUN"))
        workers = children(process.pid)
        process.kill()
    done = part_times(Path("RUN"))
    assert 1 <= len(parts("RUN")) < 4
    wait_for(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), SECONDS + 30)
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    after = part_times(Path("RUN"))
    assert {name: after[name] for name in done if name.startswith("models")} == {
        name: time for name, time in done.items() if name.startswith("models")
    }
    assert main(["run", "data", "-o", "FRESH", "--quiet"]) == 0
    assert same_rows(Path("RUN"), Path("FRESH"))


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_an_interrupt_is_130_and_keeps_what_is_finished(jobs):
    with start_cli("run", "data", "-o", "RUN", "--jobs", jobs, stub="stuck", start_new_session=True) as process:
        wait_for(lambda: len(parts("RUN")) == 3)  # with two processes, one is busy now and one is idle
        os.killpg(process.pid, signal.SIGINT)  # as a terminal sends it: to the workers too
        out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert out == ""
    assert err.strip().count("\n") == 0
    assert "interrupted" in err
    assert len(parts("RUN")) == 3
    assert main(["run", "data", "-o", "RUN", "--quiet"]) == 0
    assert len(parts("RUN")) == 4


def test_a_second_run_into_the_same_folder_is_2(capsys):
    with start_cli("run", "data", "-o", "RUN", "--jobs", "1", stub="slow") as process:
        wait_for(lambda: Path("RUN/run.json").exists())
        assert main(["run", "data", "-o", "RUN"]) == 2
        assert "another run is writing here" in capsys.readouterr().err
        process.communicate(timeout=60)
    assert process.returncode == 0
    assert len(parts("RUN")) == 4


def test_list_prints_the_models_and_audits_nothing(capsys):
    assert main(["run", "data", "--list"]) == 0
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert [row[:3] for row in rows] == [["data", name, "0"] for name in sorted(NAMES)]
    assert all((int(row[3]), int(row[4]) > 1000) == (5, True) for row in rows)
    assert main(["run", "nothing", "--list"]) == 3


def children(pid: int) -> list[int]:
    """Return the processes whose parent is ``pid``."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found
