"""scripts/fuzz_kernels.py: which kernels there are, what it does to numbers, which leaks are theirs.

Whether every kernel is called is what the script itself says, in .ci/run.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
_spec = importlib.util.spec_from_file_location("fuzz_kernels", ROOT / "scripts" / "fuzz_kernels.py")
fuzz_kernels = importlib.util.module_from_spec(_spec)
_path = list(sys.path)
_spec.loader.exec_module(fuzz_kernels)
sys.path[:] = _path


def test_kernels_are_found_as_they_are_written(tmp_path):
    (tmp_path / "a.c").write_text(
        '#include "kernel.h"\n'
        "static int64_t no_kernel(double x) { return 0; }\n"
        "KERNEL int64_t first(const double *x) { return DONE; }\n"
        "KERNEL int64_t second(\n    const double *x) { return DONE; }\n"
        "KERNEL int64_t\nthird(int64_t n) { return DONE; }\n"
        "KERNEL const char *sfm_audit_sources(void) { return 0; }\n"
        "KERNEL int64_t sfm_audit_runs_here(void) { return 1; }\n",
        encoding="utf-8",
    )
    assert fuzz_kernels.symbols(tmp_path) == {"first", "second", "third"}


def test_every_exported_name_of_the_sources_is_a_kernel():
    """What the loader can bind is what the script looks for."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in fuzz_kernels.build_kernels.SOURCES.glob("*.c"))
    marked = sum(line.lstrip().startswith("KERNEL") for line in text.splitlines())
    assert len(fuzz_kernels.symbols()) == marked - len(fuzz_kernels.NO_KERNEL)


def test_numbers_are_damaged_in_copies_and_whole_numbers_are_not():
    rng = np.random.default_rng(0)
    given = [np.ones(50), np.arange(5), 3, np.zeros(0), np.ones((4, 3))]
    changed = set()
    for _ in range(50):
        found = fuzz_kernels.damaged(given, rng)
        assert np.array_equal(found[1], np.arange(5))
        assert found[2] == 3
        assert [each.shape for each in found if isinstance(each, np.ndarray)] == [(50,), (5,), (0,), (4, 3)]
        changed |= {k for k in (0, 4) if not np.array_equal(found[k], given[k])}
    assert changed == {0, 4}
    assert np.array_equal(given[0], np.ones(50))


def test_a_leak_of_a_kernel_is_told_and_those_of_python_are_not():
    ours = "Direct leak of 800 byte(s) in 1 object(s) allocated from:\n    #1 in sum /x/audit/kernels/source/a.c:2\n\n"
    other = "Direct leak of 8 byte(s) in 1 object(s) allocated from:\n    #1 in PyObject_Malloc Objects/obmalloc.c\n\n"
    assert fuzz_kernels.kernel_leaks(f"==1==ERROR: LeakSanitizer\n\n{other}{ours}{other}SUMMARY: x\n") == [ours]


def test_calls_are_kept_and_the_last_name_is_written_down(tmp_path):
    recorder = fuzz_kernels.Recorder(tmp_path / "now")
    seen = []
    called = recorder.wrap("one", lambda *given: seen.append(given) or 7)
    array = np.arange(3.0)
    assert called(array, 3) == 7
    array[:] = 0.0
    ((_, kept),) = recorder.calls["one"]
    assert np.array_equal(kept[0], [0.0, 1.0, 2.0])
    assert (tmp_path / "now").read_text() == "one"
    for _ in range(100):
        called(array, 3)
    assert len(recorder.calls["one"]) == fuzz_kernels.KEPT
