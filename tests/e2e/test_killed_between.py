"""kill -9 between the steps that bring a run to the disk: what the verbs say of what is left, what a rerun makes."""

import shutil
import sys
from pathlib import Path

import pytest
from run_samples import read_run, write_models

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs fork and limits that hold")
RUN = ("run", "data", "-o", "RUN", "--quiet", "--jobs", "1")
READERS = (
    ("check", "RUN", "--policy-file", "gate.toml"),
    ("filter", "RUN", "--list", "list.txt", "--force"),
    ("diff", "REF", "RUN"),
    ("report", "RUN", "-o", "page.html", "--force", "--worst", "0"),
    ("explain", "RUN", "id:1", "-o", "story", "--force"),
)


@pytest.fixture(scope="module")
def cli():
    from cli_server import CliServer  # noqa: PLC0415 - it imports resource, which Windows lacks

    with CliServer() as server:
        yield server


@pytest.fixture(scope="module")
def source(cli, tmp_path_factory):
    folder = tmp_path_factory.mktemp("killed")
    write_models(folder / "data", ["a", "b"], num_points=40)
    (folder / "gate.toml").write_text("limits.max_share_rejected = 1.0\n")
    assert cli("run", "data", "-o", "REF", "--quiet", "--jobs", "1", cwd=folder).code == 0
    return folder


@pytest.mark.parametrize("kill_at", [0, 4, 8, 13, 22])  # before which renaming or flushing, counted from 0
def test_what_a_kill_between_two_steps_leaves_is_told_and_completed(cli, source, kill_at):
    shutil.rmtree(source / "RUN", ignore_errors=True)
    assert cli(*RUN, cwd=source, kill_at=kill_at).code == -9
    for words in READERS:
        answer = cli(*words, cwd=source)
        assert answer.code in ({2, 3} if words[0] in {"check", "filter", "diff"} else {0, 2, 3}), answer
        assert answer.err.count("\n") == (answer.code != 0), answer
        assert not (source / "list.txt").exists()
    again = cli(*RUN, cwd=source)
    assert (again.code, again.err) == (0, "")
    expected = read_run(source / "REF")
    assert all(table.equals(expected[name]) for name, table in read_run(source / "RUN").items())
    assert not [path for path in (source / "RUN").rglob("*tmp*") if path.is_file()]
    assert Path(source / "RUN/run.json").is_file()
