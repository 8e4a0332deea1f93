"""What is imported when: whoever mistyped waits for the interpreter, and a run for nothing that it does not use."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("scipy", "pandas", "pycolmap", "matplotlib", "pyarrow.dataset", "sfm_audit.audit.engine")
ASK = """
import sys
from sfm_audit.audit.cli.main import main
code = main(sys.argv[2:])
loaded = [name for name in sys.argv[1].split() if name in sys.modules]
print(code, *loaded, file=sys.stderr)
"""
QUICK = {
    "run --help": 0,
    "run": 2,
    "run no-such-folder": 2,
    "run no-such-folder -o out": 3,
    "run no-such-folder --list": 3,
    "run . -o out --noise loud": 2,
    "run . -o out --config no-such-file.toml": 2,
    "run . -o out --jobs many": 2,
    "check no-such-run --policy-file no-such-file.toml": 2,
    "diff no-such-run another": 3,
    "learn-band no-such-run another": 3,
    "no-such-verb": 2,
    "--version": 0,
}


@pytest.mark.parametrize("line", QUICK)
def test_nothing_heavy_is_imported_for_help_and_errors(line, tmp_path):
    heavy = (*HEAVY, "rich.console", "tqdm") if line.startswith("run") else HEAVY  # the others draw tables
    command = [sys.executable, "-c", ASK, " ".join(heavy), *line.split()]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.stderr.splitlines()[-1].split() == [str(QUICK[line])], ended.stderr


def test_an_audit_imports_only_what_it_uses():
    others = (
        "rich.console",
        "tqdm",
        "scipy.optimize",
        "scipy.spatial",
        "scipy.stats",
        "pandas",
        "pycolmap",
        "matplotlib",
        "pyarrow.dataset",
        "distributed",
    )
    ask = f"import sys, sfm_audit.audit.cli.auditing; print(*[name for name in {others} if name in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert not ended.stdout.split()


def test_arrow_is_imported_when_a_table_is_made():
    ask = (
        "import sys, sfm_audit.audit.engine.model, sfm_audit.loaders; print('pyarrow' in sys.modules)\n"
        "from sfm_audit.audit.table import IMAGES, empty_table\n"
        "print(len(IMAGES) > 0, 'pyarrow' in sys.modules, empty_table('images').num_rows, 'pyarrow' in sys.modules)"
    )
    ended = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines() == ["False", "True False 0 True"]


def test_scipy_copies_no_subpackage_of_numpy_that_nobody_uses():
    ask = (
        "import sys, numpy\n"
        "from sfm_audit.audit.schedule.imports import importing_audits\n"
        "before = list(numpy.__all__), set(dir(numpy))\n"
        "with importing_audits():\n"
        "    import scipy.special, scipy.linalg, sfm_audit.audit.cli.auditing\n"
        "print(*[name for name in ('f2py', 'ma', 'polynomial', 'testing') if f'numpy.{name}' in sys.modules])\n"
        "from numpy import *\n"
        "print((list(numpy.__all__), set(dir(numpy))) == before, 'numpy.ma' in sys.modules, ma.masked is not None)"
    )
    ended = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines() == ["", "True True True"]
