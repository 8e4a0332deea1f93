"""What every model holds, however damaged the files it was read from; and how tests damage files."""

import numpy as np
from hypothesis import strategies as st

from sfm_audit.loaders import SparseModel


def assert_is_a_model(model: SparseModel) -> None:
    """The promises that the audit relies on."""
    images, observations = model.images, model.observations
    assert bool(np.all(np.diff(images.image_id.astype(np.int64)) > 0))
    assert bool(np.all(np.diff(model.cameras.camera_id.astype(np.int64)) > 0))
    assert bool(np.all(model.points.point3d_id[1:] > model.points.point3d_id[:-1]))
    assert observations.offsets[0] == 0
    assert observations.offsets[-1] == len(observations) == len(observations.xy_px)
    assert len(observations.offsets) == len(images) + 1
    assert bool(np.all((observations.point_idx >= -1) & (observations.point_idx < max(len(model.points), 1))))
    assert bool(np.all((images.camera_idx >= -1) & (images.camera_idx < max(len(model.cameras), 1))))
    for row in range(len(images)):
        assert len(images.name[row].encode()) >= 0
        camera = model.image(row).camera
        assert camera is None or len(camera.params) == camera.model.num_params
    for finding in model.findings:
        assert finding.count > 0


def damage(data: st.DataObject, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(changed) - 1))
        changed[at] = data.draw(st.integers(0, 255) | st.sampled_from(b" \n\0\xff\x7f-.#,"))
    return bytes(changed)
