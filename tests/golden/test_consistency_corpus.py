"""Real models belong together: no finding on the corpus, but for the one whose 2D points are shifted by 312.6 px."""

from __future__ import annotations

import numpy as np
from corpus import parametrize_models

from sfm_audit.audit.consistency import Cause, ConsistencyCode, consistency_of
from sfm_audit.loaders import open_model


@parametrize_models()
def test_only_the_shifted_model_disagrees(model_dir):
    found = consistency_of(open_model(model_dir))
    assert not found.inconsistent.any()
    if model_dir.name == "gtsfm_palace_txt":
        assert [(finding.code, finding.cause) for finding in found.findings] == [
            (ConsistencyCode.PARTS_DISAGREE, Cause.SHIFT)
        ]
        assert all(image.moved for image in found.images)
        for image in found.images:
            np.testing.assert_allclose(image.affine.shift_px, [0.0, -312.6], atol=0.1)
    else:
        assert found.findings == ()
        assert not any(image.moved for image in found.images)
