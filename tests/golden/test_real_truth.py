"""What must hold on reconstructions of real photos whose cameras are known."""

from __future__ import annotations

import pandas as pd
import pytest
from corpus import REALTRUTH, needs_realtruth

from scripts.realtruth.bench import audit_bench
from scripts.realtruth.bounds import bounds
from scripts.realtruth.page import document

pytestmark = [pytest.mark.corpus, needs_realtruth]
WORDS = (
    "healthy, rejected by verdict_misfit",
    "neighbours, rejected by verdict_misfit",
    "healthy, rejected by standard",
    "planted, 0.5 px and more, found",
    "cause named right",
    "focal length wrong by over 1 %, accepted, without kitti2",
    "healthy, f within 0.5 %, accepted, without temple",
    "absorbed principal point, finding implied_principal_point",
    "healthy models with implied_principal_point",
)


@pytest.fixture(scope="module")
def images() -> pd.DataFrame:
    """All models, audited once: about a minute."""
    return audit_bench(REALTRUTH)


@pytest.mark.parametrize("words", WORDS)
def test_the_rate_keeps_its_bound(words, images):
    (bound,) = [bound for bound in bounds(images) if bound.words == words]
    assert bound.rate.of
    assert bound.holds, str(bound)


def test_no_bound_is_left_out(images):
    assert [bound.words for bound in bounds(images)] == list(WORDS)


def test_the_page_names_no_photo(images):
    page = document(images, None)
    assert not [name for name in images.image_name if name in page]
    assert "healthy" in page
