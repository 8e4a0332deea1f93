"""The script that changes decisions one by one: what it changes, and what it says of survivors."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from scripts.mutation import survivors  # noqa: E402
from scripts.mutation.mutants import Mutant, Named, Target, mutants_of  # noqa: E402
from scripts.mutation.targets import NAMED, TARGETS  # noqa: E402

SOURCE = '''
LIMIT: Final = 2.0
def judged(value: float | None, limits=(1, 0)):
    """Return not 1 < 2."""
    if value is None or not value < LIMIT:
        return Verdict.REJECTED, f"{value + 1}"
    return min(abs(value), 3)
'''


def changes(tmp_path, source, *names: str):
    (tmp_path / "toy.py").write_text(source)
    return list(mutants_of(Target("toy.py", ("unit/test_toy.py",), names), tmp_path))


def test_each_mutant_is_one_change_of_what_decides(tmp_path):
    found = {mutant.key.removeprefix("toy.py judged: "): mutant.source for mutant in changes(tmp_path, SOURCE)}
    assert set(found) == {
        "constant `1` -> `2`",
        "constant `0` -> `1`",
        "without `1` `(1, 0)` -> `(0,)`",
        "without `0` `(1, 0)` -> `(1,)`",
        "always True `value is None or not value < LIMIT` -> `True`",
        "always False `value is None or not value < LIMIT` -> `False`",
        "condition `value is None or not value < LIMIT` -> `value is None and (not value < LIMIT)`",
        "dropped `value is None or not value < LIMIT` -> `value is None`",
        "dropped `value is None or not value < LIMIT` -> `not value < LIMIT`",
        "comparison `value is None` -> `value is not None`",
        "operator `not value < LIMIT` -> `value < LIMIT`",
        "comparison `value < LIMIT` -> `value <= LIMIT`",
        "comparison `value < LIMIT` -> `value > LIMIT`",
        "return `(Verdict.REJECTED, f'{value + 1}')` -> `None`",
        "without `Verdict.REJECTED` `(Verdict.REJECTED, f'{value + 1}')` -> `(f'{value + 1}',)`",
        "without `f'{value + 1}'` `(Verdict.REJECTED, f'{value + 1}')` -> `(Verdict.REJECTED,)`",
        "word `Verdict.REJECTED` -> `Verdict.ACCEPTED`",
        "return `min(abs(value), 3)` -> `None`",
        "call `min(abs(value), 3)` -> `max(abs(value), 3)`",
        "dropped `abs(value)` -> `value`",
        "constant `3` -> `6`",
    }
    for source in found.values():
        compile(source, "toy.py", "exec")
        assert "value: float | None" in source
        assert "f'{value + 1}'" in source or "None" in source
    assert "value <= LIMIT" in found["comparison `value < LIMIT` -> `value <= LIMIT`"]


def test_constants_are_named_and_a_name_that_is_gone_is_said(tmp_path):
    assert [mutant.key for mutant in changes(tmp_path, SOURCE, "LIMIT")] == ["toy.py LIMIT: constant `2.0` -> `4.0`"]
    with pytest.raises(SystemExit, match=r"toy\.py has no gone"):
        changes(tmp_path, SOURCE, "gone")
    with pytest.raises(SystemExit, match="stands there 0 x"):
        Named("x", "toy.py", "no such text", "", ()).mutant(tmp_path)


def test_equal_changes_are_numbered(tmp_path):
    keys = [mutant.key for mutant in changes(tmp_path, "def two(a, b):\n    return a < 1, b, a < 1\n")]
    assert "toy.py two: comparison `a < 1` -> `a <= 1`" in keys
    assert "toy.py two: comparison `a < 1` -> `a <= 1` (2)" in keys


def test_targets_and_named_mutants_are_there():
    assert all(named.mutant(ROOT).source for named in NAMED)
    assert len({named.name for named in NAMED}) == len(NAMED)
    for target in TARGETS:
        assert next(iter(mutants_of(target, ROOT)))
        assert all((ROOT / "tests" / test.partition("::")[0]).is_file() for test in target.tests)


def test_reasons_of_survivors_are_kept_and_asked_for(tmp_path):
    a, b, named = (Mutant(key, "a.py", (), "", key == "named") for key in ("a.py x", "a.py y", "named"))
    (tmp_path / "docs").mkdir()
    (tmp_path / survivors.LIST).write_text(f"# Survivors\n\n{survivors._BEGIN}\n- b.py z — because\n")
    survivors.update(tmp_path, [a, b], [a])
    assert survivors.read(tmp_path) == {"a.py x": "?", "b.py z": "because"}
    assert survivors.faults(tmp_path, [a, b], [a], complete=True) == [
        f"survived without a reason in {survivors.LIST}: a.py x"
    ]
    path = tmp_path / survivors.LIST
    path.write_text(path.read_text().replace("a.py x — ?", "a.py x — equal"))
    assert survivors.faults(tmp_path, [a, b], [a], complete=True) == []
    assert survivors.faults(tmp_path, [a, b], [], complete=False) == [f"dies, and stands in {survivors.LIST}: a.py x"]
    assert survivors.faults(tmp_path, [b], [], complete=True) == [f"is gone, and stands in {survivors.LIST}: a.py x"]
    assert survivors.faults(tmp_path, [b], [], complete=False) == []
    assert survivors.faults(tmp_path, [named], [named], complete=False) == ["a named mutant survived: named"]


def test_every_survivor_has_a_reason():
    assert all(reason not in {"", "?"} for reason in survivors.read(ROOT).values())


def test_a_mutant_dies_and_an_equal_one_survives():
    code = """
import sys; sys.path.insert(0, '.')
from pathlib import Path
from scripts.mutation.mutants import Mutant
from scripts.mutation import runner as running
running.PRELOADED_TOO = ()  # not needed by so small a test
file, tests = 'audit/table/words.py', ('unit/test_decision_severity.py',)
source = Path(file).read_text()
dead = source.replace('Severity.HARD: 0', 'Severity.HARD: 9')
mutants = [Mutant(str(k), file, tests, text) for k, text in enumerate((dead, source + '#', 'raise ValueError'))]
runner = running.Runner(Path('.').resolve(), 3)
runner.check_unchanged({tests})
print({str(mutant): outcome.value for mutant, outcome in runner.run(mutants)})
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert eval(done.stdout) == {"0": "died", "1": "survived", "2": "died"}, done.stderr  # noqa: S307 # our own print
