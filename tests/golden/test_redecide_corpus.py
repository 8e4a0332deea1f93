"""Real models and reported symptoms decided again: the run's own settings change nothing, policies are runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pytest
from corpus import CORPUS, parametrize_models

from sfm_audit.audit import AuditConfig, audit_model
from sfm_audit.audit.decision.from_table import redecide
from sfm_audit.loaders import open_model

SYMPTOMS = Path(os.environ.get("SFM_AUDIT_SYMPTOMS", CORPUS.parent / "cases" / "symptoms"))
CASES = [*sorted(SYMPTOMS.glob("c*.py")), *sorted(SYMPTOMS.glob("inputs/*"))]
needs_symptoms = pytest.mark.skipif(not CASES, reason=f"no symptoms at {SYMPTOMS} (set SFM_AUDIT_SYMPTOMS)")

RUN, OTHER = AuditConfig(), AuditConfig(policy="full", max_noise_distance=0.01, max_sd_focal_rel=0.05)


def differing(found: pa.Table, wanted: pa.Table) -> list[str]:
    assert found.schema == wanted.schema
    return [
        name
        for name in wanted.column_names
        if repr(found.column(name).to_pylist()) != repr(wanted.column(name).to_pylist())  # NaN in lists
    ]


@parametrize_models()
def test_a_real_model_decides_again_as_it_did(model_dir):
    images = audit_model(open_model(model_dir), RUN).images
    assert differing(redecide(images, RUN, run=RUN), images) == []


@pytest.mark.corpus
@needs_symptoms
@pytest.mark.parametrize("case", CASES or [None], ids=lambda case: case.stem if case else "no-symptoms")
def test_a_symptom_decides_again_as_it_did(case, tmp_path):
    folder = case
    if case.suffix == ".py":
        folder = tmp_path / "model"
        done = subprocess.run([sys.executable, case.name, folder], cwd=case.parent, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
    model = open_model(folder)
    images, other = audit_model(model, RUN).images, audit_model(model, OTHER).images
    assert differing(redecide(images, RUN, run=RUN), images) == []
    assert differing(redecide(images, OTHER, run=RUN), other) == []
    assert differing(redecide(other, RUN, run=OTHER), images) == []
