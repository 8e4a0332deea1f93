"""The models that tests compare with: real ones, ones with ground truth, ones with a fault; no part of the project.

All of them may be absent: the tests are skipped then, and say so.
"""

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "corpus"
CORPUS = Path(os.environ.get("SFM_AUDIT_CORPUS", _DEFAULT))
IS_THERE = (CORPUS / "models").is_dir()
needs_corpus = pytest.mark.skipif(not IS_THERE, reason=f"no corpus of real models at {CORPUS} (set SFM_AUDIT_CORPUS)")

REALTRUTH = CORPUS.parent / "realtruth"
SYMPTOMS = CORPUS.parent / "cases" / "symptoms"
FOLDS = CORPUS.parent / "folds"
_HAS_TRUTH = any(REALTRUTH.glob("*/truth.json"))
needs_realtruth = pytest.mark.skipif(not _HAS_TRUTH, reason=f"no models with ground truth at {REALTRUTH}")
needs_folds = pytest.mark.skipif(not FOLDS.is_dir(), reason=f"no folded models at {FOLDS}")
needs_symptoms = pytest.mark.skipif(not SYMPTOMS.is_dir(), reason=f"no models with known faults at {SYMPTOMS}")

UNREADABLE = frozenset({"xiting_lfs", "marychrisgo_nopoints", "kapture_t265_txt"})
REFUSED_BY_PYCOLMAP = UNREADABLE | {"gtsfm_palace_txt", "gtsfm_lund_cluster_txt"}


def corpus_models(*, more: bool = False) -> list[Path]:
    """Return all model folders of the corpus, the broken ones included; none where there is no corpus.

    more: those of its folder `more` too, some of which pycolmap does not read.
    """
    if not IS_THERE:
        return []
    models = [path for path in (CORPUS / "models").iterdir() if path.is_dir()]
    models += (CORPUS / "megadepth_like").glob("*/*/sparse/manhattan/*")
    if more:
        models += [path.parent for path in (CORPUS / "more").glob("*/images.*")]
    return sorted(set(models))


def parametrize_models(argname: str = "model_dir", *, excluded: frozenset[str] = UNREADABLE, more: bool = False):
    """Return a decorator that runs a test once per corpus model, and skips it, saying so, without a corpus."""
    paths = [path for path in corpus_models(more=more) if path.name not in excluded]
    params = [pytest.param(path, id=str(path.relative_to(CORPUS)), marks=pytest.mark.corpus) for path in paths]
    absent = pytest.param(None, id="no-corpus", marks=[pytest.mark.corpus, needs_corpus])
    return pytest.mark.parametrize(argname, params or [absent])
