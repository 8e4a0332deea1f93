"""Fixtures that several folders of tests share."""

from pathlib import Path

import pytest
from corpus import CORPUS, IS_THERE


@pytest.fixture(scope="session")
def corpus() -> Path:
    """The folder of the corpus of real models; the test is skipped where there is none."""
    if not IS_THERE:
        pytest.skip(f"no corpus of real models at {CORPUS} (set SFM_AUDIT_CORPUS)")
    return CORPUS
