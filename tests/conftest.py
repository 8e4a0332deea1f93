"""Fixtures that several folders of tests share."""

from pathlib import Path

import pytest
from corpus import CORPUS, IS_THERE
from hypothesis import settings

# The same examples every time, so that red means the change; --hypothesis-profile=default looks for new ones.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, print_blob=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def corpus() -> Path:
    """The folder of the corpus of real models; the test is skipped where there is none."""
    if not IS_THERE:
        pytest.skip(f"no corpus of real models at {CORPUS} (set SFM_AUDIT_CORPUS)")
    return CORPUS
