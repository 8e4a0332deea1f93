import os
import subprocess
import sys
from pathlib import Path

import click
import pytest

from sfm_audit.audit.cli import main, terminal
from sfm_audit.audit.cli.errors import ExitCode, KnownError


@pytest.fixture
def raising(monkeypatch):
    """Make ``sfm-audit demo`` raise an error."""

    def set_error(error: BaseException):
        @click.command("demo")
        def command() -> None:
            raise error

        monkeypatch.setattr(main.LazyGroup, "get_command", lambda *_: command)

    return set_error


def test_help_names_every_verb_and_costs_no_science():
    code = (
        "import sys\nfrom sfm_audit.audit.cli.main import main\nmain(['--help'])\n"
        "heavy = {'numpy', 'scipy', 'pyarrow', 'pandas', 'pycolmap', 'pydantic', 'rich', 'tqdm'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for verb, text in main.VERBS.items():
        assert verb in done.stdout
        assert text in " ".join(done.stdout.split())  # a long line is wrapped
    assert done.stdout.endswith("[]\n")


def test_the_installed_command_prints_its_version():
    command = Path(sys.executable).with_name("sfm-audit")
    done = subprocess.run([command, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("sfm-audit 0.")


@pytest.mark.parametrize("verb", main.VERBS)
def test_every_verb_has_help(verb, capsys):
    assert main.main([verb, "--help"]) == 0
    assert f"sfm-audit {verb}" in capsys.readouterr().out


def test_without_arguments_it_helps(capsys):
    assert main.main([]) == 0
    assert "Commands" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["rnu"], "No such command 'rnu'"),
        (["run"], "Missing argument 'PATH...'"),
        (["run", "a"], "Missing option '-o'"),
        (["run", "a", "-o", "b", "--jobs", "0"], "--jobs"),
        (["run", "a", "-o", "b", "--noise", "loud"], "loud"),
        (["run", "a", "-o", "b", "--policy", "none"], "none"),
        (["run", "a", "-o", "b", "--min-effect", "nonsense"], "--min-effect: expected a number with its unit"),
        (["run", "a", "-o", "b", "--min-effect", "0.2 px"], "found '0.2 px'"),
        (["run", "a", "-o", "b", "--points", "independent"], "points = independent takes noise = constant, not track"),
        (
            ["run", "a", "-o", "b", "--points", "independent", "--noise", "keypoint"],
            "--noise, --points: points = independent takes noise = constant, not keypoint",
        ),
        (["run", "a", "-o", "b", "--config", "none.toml"], "none.toml: cannot be read"),
    ],
)
def test_wrong_usage_is_one_line_and_2(args, words, capsys):
    assert main.main(args) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("sfm-audit: ")
    assert words in err
    assert err.count("\n") == 1


def test_a_known_error_is_one_line_and_its_code(raising, capsys):
    raising(KnownError("RUN: disk\nfull", ExitCode.OUTPUT))
    assert main.main(["demo"]) == 4
    assert capsys.readouterr().err == "sfm-audit: RUN: disk full\n"


def test_an_interrupt_is_one_line_and_130(raising, capsys):
    raising(KeyboardInterrupt())
    assert main.main(["demo"]) == 130
    assert capsys.readouterr().err.strip().startswith("sfm-audit: interrupted")


def test_an_unknown_error_keeps_its_traceback(raising):
    raising(ZeroDivisionError("a bug"))
    with pytest.raises(ZeroDivisionError, match="a bug"):
        main.main(["demo"])


def test_the_exit_code_of_a_bug_is_not_that_of_a_gate_that_failed(raising, monkeypatch, capsys):
    raising(ZeroDivisionError("a bug"))
    monkeypatch.setattr(main, "_SIGNALS", {})
    monkeypatch.setattr(sys, "argv", ["sfm-audit", "demo"])
    with pytest.raises(SystemExit) as end:
        main.entry_point()
    assert end.value.code == 5
    assert "ZeroDivisionError: a bug" in capsys.readouterr().err


def test_too_little_memory_is_one_line_and_5(raising, capsys):
    raising(MemoryError())
    assert main.main(["demo"]) == 5
    assert capsys.readouterr().err == f"sfm-audit: {main._NO_MEMORY}\n"


def test_output_that_the_terminal_cannot_show_is_shown_by_code():
    code = "from sfm_audit.audit.cli.terminal import print_page; print_page('Zürich 東')"
    env = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert done.stdout == "Z\\xfcrich \\u6771\n"


@pytest.mark.parametrize(
    ("columns", "width"),
    [("132", 132), ("40", 40), ("10", 40), ("", 80), ("wide", 80), ("-5", 80), ("0", 40), ("1" * 5000, 80), ("²", 80)],
)
def test_without_a_terminal_columns_says_how_wide_the_page_is(columns, width, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    assert terminal.terminal_page().width == width


def test_the_page_is_80_columns_wide_where_nothing_says_otherwise(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert terminal.terminal_page().width == 80
    assert not terminal.terminal_page().colour
