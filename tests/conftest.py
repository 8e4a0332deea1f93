"""Fixtures that several folders of tests share."""

import shutil
from pathlib import Path

import pytest
from corpus import CORPUS, IS_THERE
from hypothesis import settings

from sfm_audit.audit.kernels import kernels_in_use, numpy_only

# The same examples every time, so that red means the change; --hypothesis-profile=default looks for new ones.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, print_blob=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def quick_compiler(tmp_path_factory) -> str:
    """CC for tests that build all kernels: without optimisation, which is what takes the time."""
    found = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if found is None:
        pytest.skip("no C compiler")
    path = tmp_path_factory.mktemp("compiler") / "cc"
    path.write_text(f'#!/bin/sh\nexec "{found}" "$@" -O0 -DSFM_ONE_CLONE\n')
    path.chmod(0o755)
    return str(path)


BOTH_PATHS = "both_paths: runs with compiled kernels, and again with numpy alone (docs/kernels.md)"


def pytest_configure(config):
    config.addinivalue_line("markers", BOTH_PATHS)


def pytest_generate_tests(metafunc):
    if metafunc.definition.get_closest_marker("both_paths"):
        metafunc.parametrize("arithmetic", ["compiled", "numpy"] if kernels_in_use() else ["numpy"], indirect=True)


@pytest.fixture(autouse=True)
def arithmetic(request):
    """Which path numbers take in a test that is marked both_paths; elsewhere the one that is there."""
    if getattr(request, "param", "") == "numpy":
        with numpy_only():
            yield
    else:
        yield


@pytest.fixture(scope="session")
def corpus() -> Path:
    """The folder of the corpus of real models; the test is skipped where there is none."""
    if not IS_THERE:
        pytest.skip(f"no corpus of real models at {CORPUS} (set SFM_AUDIT_CORPUS)")
    return CORPUS
