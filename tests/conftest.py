"""Fixtures that several folders of tests share."""

import os
from pathlib import Path

import pytest
from corpus import CORPUS, IS_THERE
from hypothesis import settings

# CI judges changes: the same examples every time. New ones are tried wherever else the tests run.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, print_blob=True)
if os.environ.get("CI"):
    settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def corpus() -> Path:
    """The folder of the corpus of real models; the test is skipped where there is none."""
    if not IS_THERE:
        pytest.skip(f"no corpus of real models at {CORPUS} (set SFM_AUDIT_CORPUS)")
    return CORPUS
