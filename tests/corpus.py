"""The corpus of real models that tests compare with; it is no part of the project and may be absent."""

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "corpus"
CORPUS = Path(os.environ.get("SFM_AUDIT_CORPUS", _DEFAULT))
IS_THERE = (CORPUS / "models").is_dir()
needs_corpus = pytest.mark.skipif(not IS_THERE, reason=f"no corpus of real models at {CORPUS} (set SFM_AUDIT_CORPUS)")

UNREADABLE = frozenset({"xiting_lfs", "marychrisgo_nopoints", "kapture_t265_txt"})
REFUSED_BY_PYCOLMAP = UNREADABLE | {"gtsfm_palace_txt", "gtsfm_lund_cluster_txt"}


def corpus_models() -> list[Path]:
    """Return all model folders of the corpus, the broken ones included; none where there is no corpus."""
    if not IS_THERE:
        return []
    models = [path for path in (CORPUS / "models").iterdir() if path.is_dir()]
    models += (CORPUS / "megadepth_like").glob("*/*/sparse/manhattan/*")
    return sorted(models)


def parametrize_models(argname: str = "model_dir", *, excluded: frozenset[str] = UNREADABLE):
    """Return a decorator that runs a test once per corpus model, and skips it, saying so, without a corpus."""
    paths = [path for path in corpus_models() if path.name not in excluded]
    params = [pytest.param(path, id=str(path.relative_to(CORPUS)), marks=pytest.mark.corpus) for path in paths]
    absent = pytest.param(None, id="no-corpus", marks=[pytest.mark.corpus, needs_corpus])
    return pytest.mark.parametrize(argname, params or [absent])
