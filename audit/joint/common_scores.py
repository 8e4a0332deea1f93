"""`candidate_scores` of fields that many images have in common, by passes over all observations.

A field of all images meets every column of the base, so that what is cheap image by image (`image_scores`) is not here.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.image_scores import SHIFT, asked_of, missing_of, seen_by, sums_of_base
from sfm_audit.audit.joint.system import JointSystem
from sfm_audit.audit.kernels.joint_common import CommonFields
from sfm_audit.audit.kernels.joint_scores import Asked
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.model import CameraRecord

_MIN_SHARE: Final = 0.1  # of the observations; below it, going through those of the images alone is cheaper


def common_scores(
    system: JointSystem, images: IntArray, camera: CameraRecord | None, power: int
) -> CandidateScores | None:
    """Return the scores of parameters that some images have in common; None for the numpy path.

    Parameters
    ----------
    camera : of all the images: the six columns of what it lacks, see `sfm_audit.audit.joint.implied`; None: the two of
        the principal point
    power : of r^2 in the next radial term

    Notes
    -----
    With O taking values off the points (v - J V^-1 J^T w v):  R = N^T w O E,  B = S^+ R,  K = E^T w O E - R^T B,
    u = E^T w y~,  G_t = sum over the views of a track of w y~^T (E - N B).
    """
    base, observations = system.base, system.observations
    layout = observations.layout
    num_own = int(np.diff(observations.offsets)[images].sum())
    sums = None if base.included or num_own < _MIN_SHARE * observations.source.size else sums_of_base(base)
    if sums is None:
        return None
    if camera is None:
        nothing = np.zeros(0, dtype=np.int64)
        asked, made_of = Asked(images, np.zeros((0, 27)), nothing, nothing), SHIFT
    else:
        asked, made_of = (
            asked_of(system, images, [camera] * images.size, np.full(images.size, power)),
            missing_of(camera),
        )
    fields = CommonFields(sums, seen_by(system), asked, made_of)
    found = fields.gram()
    along = None if found is None else fields.right(found.absorbed)
    if found is None or along is None or not np.isfinite(along).all():
        return None
    found = found._replace(absorbed=found.absorbed[:0])  # much memory that nobody needs any more
    right = _collected(layout.columns, observations.transform, along, layout.num_columns)
    support = np.arange(layout.num_columns, dtype=np.int64)
    solution = base.inverse.times(support, right)
    padded = np.vstack([solution, np.zeros((1, right.shape[1]))])
    track_scores = fields.track_scores(observations.transform @ padded[layout.columns])
    if track_scores is None:
        return None
    own = track_scores[found.is_seen]
    gram = found.gram - right.T @ solution
    of_fields = found.sq_length, 0.5 * (gram + gram.T), found.score, own.T @ own, len(own)
    return CandidateScores(*of_fields, right, support, solution, num_own)


def _collected(columns: IntArray, transform: FloatArray, along: FloatArray, num_columns: int) -> FloatArray:
    """(D, c) sum of T^T along (I, C, c) at the columns (I, C) of each image; ``num_columns`` where it has none."""
    out = np.zeros((num_columns + 1, along.shape[2]))
    np.add.at(out, columns, transform.transpose(0, 2, 1) @ along)
    return out[:-1]
