"""Which path numbers took, compiled kernels or numpy, stands in the run folder, is said, and binds nobody."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from run_samples import write_models

from sfm_audit.audit.cli.main import main
from sfm_audit.audit.kernels import library as kernels
from sfm_audit.audit.kernels import path_taken
from sfm_audit.reports.run_folder.reader import RunReader


def test_numpy_asked_for_is_recorded_for_run_and_models(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("SFM_AUDIT_KERNELS", "0")
    write_models(tmp_path / "data", ("a",))
    run = tmp_path / "RUN"
    assert main(["run", str(tmp_path / "data"), "-o", str(run), "--jobs", "1", "-v"]) == 0
    said = json.loads((run / "run.json").read_bytes())["kernels"]
    assert said == {"name": "numpy", "reason": "SFM_AUDIT_KERNELS=0", "sources": None, "models": {"numpy": 1}}
    (line,) = (run / "manifest.jsonl").read_bytes().splitlines()
    assert json.loads(line)["computed_by"] == "numpy"
    printed = capsys.readouterr()
    assert printed.err.count("computing with numpy alone: SFM_AUDIT_KERNELS=0") == 1
    assert "computed alike" not in printed.out
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == "numbers by numpy (SFM_AUDIT_KERNELS=0)"


def test_a_run_goes_on_with_the_other_path_and_says_that_they_are_mixed(tmp_path, monkeypatch, capsys):
    write_models(tmp_path / "data", ("a",))
    command = ["run", str(tmp_path / "data"), "-o", str(tmp_path / "RUN"), "--jobs", "1"]
    other = "compiled 0123456789ab"
    with monkeypatch.context() as patch:
        patch.setattr("sfm_audit.audit.schedule.task.path_taken", lambda: other)
        assert main(command) == 0
    first = next((tmp_path / "RUN" / "images").iterdir())
    written = first.stat().st_mtime_ns
    write_models(tmp_path / "data", ("b",))
    capsys.readouterr()
    assert main(command) == 0
    assert first.stat().st_mtime_ns == written  # kept: its numbers are the same to 1e-9
    said = RunReader.open(tmp_path / "RUN").info["kernels"]
    own = str(path_taken())
    assert said["models"] == {other: 1, own: 1}
    printed = " ".join(capsys.readouterr().out.split())
    assert f"Not all models were computed alike: 1 by {other}, 1 by {own}." in printed


def test_a_run_from_before_there_were_kernels_is_read(tmp_path):
    write_models(tmp_path / "data", ("a",))
    run = tmp_path / "RUN"
    assert main(["run", str(tmp_path / "data"), "-o", str(run), "--jobs", "1", "--quiet"]) == 0
    content = json.loads((run / "run.json").read_bytes())
    del content["kernels"]
    (run / "run.json").write_text(json.dumps(content), encoding="utf-8")
    assert RunReader.open(run).info["kernels"] is None


def test_to_insist_on_kernels_that_are_not_there_is_one_line(tmp_path, monkeypatch, capsys):
    write_models(tmp_path / "data", ("a",))
    monkeypatch.setenv("SFM_AUDIT_KERNELS", "1")
    monkeypatch.setattr(kernels, "_loaded", lambda: (None, "no library was built"))
    assert main(["run", str(tmp_path / "data"), "-o", str(tmp_path / "RUN")]) == 2
    said = capsys.readouterr().err
    assert said == "sfm-audit: SFM_AUDIT_KERNELS=1, but there are no compiled kernels: no library was built\n"
    assert not (tmp_path / "RUN").exists()


@pytest.mark.parametrize(("built_from", "said"), [("0" * 64, "is of other sources"), (None, "cannot be loaded")])
def test_a_library_of_other_sources_is_not_used(tmp_path, monkeypatch, built_from, said):
    library = tmp_path / kernels.LIBRARY.name
    if built_from is None or not kernels.LIBRARY.exists():
        built_from, said = None, "cannot be loaded"
        library.write_bytes(b"no library")
    else:
        library.write_bytes(kernels.LIBRARY.read_bytes().replace(kernels.sources_hash().encode(), built_from.encode()))
    monkeypatch.setattr(kernels, "LIBRARY", library)
    monkeypatch.delenv("SFM_AUDIT_KERNELS", raising=False)
    kernels._loaded.cache_clear()
    try:
        path = path_taken()
        assert (path.name, path.sources) == ("numpy", None)
        assert said in path.reason
    finally:
        kernels._loaded.cache_clear()


def test_a_library_for_other_processors_is_not_used(monkeypatch):
    old = SimpleNamespace(sfm_audit_sources=lambda: kernels.sources_hash().encode(), sfm_audit_runs_here=lambda: 0)
    monkeypatch.setattr(kernels.ctypes, "CDLL", lambda _: old)
    monkeypatch.setattr(kernels, "LIBRARY", Path(__file__))
    monkeypatch.delenv("SFM_AUDIT_KERNELS", raising=False)
    kernels._loaded.cache_clear()
    try:
        assert path_taken().name == "numpy"
        assert "needs a processor with AVX2 and FMA" in path_taken().reason
    finally:
        kernels._loaded.cache_clear()


def test_the_library_that_is_there_is_of_these_sources():
    if kernels.LIBRARY.exists():
        assert kernels.sources_hash().encode() in kernels.LIBRARY.read_bytes(), "run scripts/build_kernels.py"
