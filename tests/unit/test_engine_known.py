"""What is known of images as columns: cases that few models have, each beside one that is different."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from decision_models import model_with
from numpy.testing import assert_array_equal

from sfm_audit.audit.consistency import ImageConsistency
from sfm_audit.audit.decision.diagnostics import SharedMisfit
from sfm_audit.audit.decision.measured import STATUS_CODES, MeasuredParts
from sfm_audit.audit.engine import known
from sfm_audit.audit.engine.image import unusable_reason
from sfm_audit.audit.engine.jointly import consistency_diagnostics
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus
from sfm_audit.loaders.camera_models import BY_ID

SHARED = SharedMisfit.of(7, 12, MisfitGroup.TANGENTIAL, 0.41, 1e-9)
PANORAMA, SIMPLE_RADIAL = 17, 2
TURNED = SimpleNamespace(text="turned by 90 degrees")
FITS = ImageConsistency("a", 1, 300, 1.0, 0.6, 0.5, inconsistent=False)
PARTS = (
    FITS,
    replace(FITS, inconsistent=True, explanation=TURNED, rms_px=9.0),
    replace(FITS, moved=True, explanation=TURNED),
    replace(FITS, num_linked=3, share_in_front=0.0, inconsistent=None),
    replace(FITS, num_linked=3, share_in_front=0.4, inconsistent=None),
    replace(FITS, num_linked=0, share_in_front=0.0, inconsistent=None, rms_px=np.nan),
    replace(FITS, num_linked=3, share_in_front=0.0),
)


@pytest.mark.parametrize("behind", [False, True])
def test_parts_are_those_of_each_image(behind):
    found = known._parts(SimpleNamespace(images=PARTS, points_behind=behind), range(1, len(PARTS)))
    wanted = MeasuredParts.of([consistency_diagnostics(each, all_behind=behind) for each in PARTS[1:]])
    assert found.texts == wanted.texts
    assert found.all_behind.tolist() == ([True] * 6 if behind else [False, False, True, False, False, False])
    for name in ("known", "inconsistent", "all_behind", "rms_px"):
        assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_steps_are_of_images_that_take_part_in_the_joint_system():
    images = SimpleNamespace(camera_idx=np.array([0, 0, 0, 1, -1, 0]))
    joint = SimpleNamespace(num_observations=np.array([1, 0, 9, 9, 9, 9]))
    facts = SimpleNamespace(model=SimpleNamespace(images=images), joint=joint, steps={0: "step"})
    asked = np.array([True, True, True, True, False, False])
    steps = known._steps(facts, np.arange(6), asked)
    assert steps == ["step", None, "step", None, None, None]
    facts.joint = None
    assert known._steps(facts, np.arange(6), asked) == [None] * 6


@pytest.mark.parametrize("column", ["quat_cam_from_world_wxyz", "translation_cam_from_world"])
@pytest.mark.parametrize("value", [np.nan, 1e13])
def test_one_odd_number_of_a_pose_is_enough(column, value):
    model = model_with()
    changed = getattr(model.images, column).copy()
    changed[4, 1] = value
    model = replace(model, images=replace(model.images, **{column: changed}))
    found = known._unusable(model, range(2, 6), np.array([True, False, True, False]))
    assert found == {2: unusable_reason(model.image(4))}


def quality(model_id, centre):
    has_focal = model_id != PANORAMA
    plausibility = SimpleNamespace(focal_over_size=0.8, folds_over=False, principal_point_px=centre)
    parameters = SimpleNamespace(singular_share=0.1, is_singular=False)
    numbers = {"sd_focal_rel": 0.001, "sd_k1": 0.002, "k1": 0.05, "has_k1": has_focal, "has_focal": has_focal}
    return SimpleNamespace(
        shape=SimpleNamespace(plausibility=plausibility, camera=SimpleNamespace(model=BY_ID[model_id])),
        identifiability=SimpleNamespace(parameters=parameters, **numbers),
        coverage=0.5,
        occupied_cells=40,
    )


def test_a_panorama_has_no_focal_length_to_lose():
    lost = SimpleNamespace(names=("k", "f"), sd=np.array([0.3, np.nan]), sd_focal_rel=np.nan, focal_identified=False)
    qualities = [quality(PANORAMA, None), quality(SIMPLE_RADIAL, (800.0, 600.0)), quality(SIMPLE_RADIAL, (8.0, 6.0))]
    size_px = np.full((3, 2), 1000)
    found = known._camera(qualities, np.ones(3, dtype=bool), size_px, [lost, lost, None])
    assert found.is_singular.tolist() == [False, True, False]
    assert_array_equal(found.principal_point_px, [(np.nan, np.nan), (800.0, 600.0), (8.0, 6.0)])
    assert_array_equal(found.sd_k1, [np.nan, 0.3, 0.002])
    assert found.is_joint.tolist() == [True, True, False]
    fixed = SimpleNamespace(names=("f",), sd=np.array([0.3]), sd_focal_rel=0.004, focal_identified=True)
    found = known._camera([quality(SIMPLE_RADIAL, (8.0, 6.0))], np.ones(1, dtype=bool), size_px[:1], [fixed])
    assert_array_equal([*found.sd_k1, *found.sd_focal_rel], [np.nan, 0.004])


def test_cameras_that_nobody_measured_have_no_numbers():
    found = known._camera([None, None], np.zeros(2, dtype=bool), np.full((2, 2), 1000), [None, None])
    assert not found.known.any()
    assert not found.size_px.any()
    assert np.isnan([found.coverage, found.k1, found.sd_focal_rel, *found.principal_point_px.T]).all()


def test_a_panorama_has_no_parameters_of_its_own():
    cameras = SimpleNamespace(model_id=np.array([PANORAMA, SIMPLE_RADIAL]))
    model = SimpleNamespace(cameras=cameras, images=SimpleNamespace(camera_idx=np.array([0, 1, 1])))
    measured = np.array([True, True, False])
    found = known._own(SimpleNamespace(model=model, own={}), np.arange(3), measured, [None] * 3)
    assert found.has_own.tolist() == [False, True, False]


class JointTest:
    """A joint test of one image that says which one it is."""

    status, rank = MisfitStatus.TESTED, 2
    worth = SimpleNamespace(rotation_deg=0.1, centre_rel=0.2, focal_rel=0.3)

    def __init__(self, image_idx) -> None:
        self.q, self.px = 0.01 * image_idx, 0.1 * image_idx

    def bic(self, num):
        return float(num)


def misfit_facts(joint):
    return SimpleNamespace(
        joint=joint,
        consistency=SimpleNamespace(inconsistent=np.array([False, True, False, False])),
        residuals=SimpleNamespace(offsets=np.array([0, 100, 200, 300, 300])),
        sigma_constant_px=np.full(4, 0.5),
        shared_misfit=lambda i: SHARED if i == 2 else None,
    )


@pytest.mark.parametrize("most_are_wrong", [False, True])
def test_joint_tests_are_of_images_whose_parts_fit(most_are_wrong):
    tests = [dict.fromkeys(GROUPS, JointTest(i)) for i in range(4)]
    joint = SimpleNamespace(
        misfit=SimpleNamespace(tests=tests, most_are_wrong=most_are_wrong), num_observations=np.array([90, 91, 92, 0])
    )
    measured = np.array([True, True, True, False])
    found = known._misfit(misfit_facts(joint), range(4), measured)
    assert found.shared == ({2: SHARED} if most_are_wrong else {})
    assert_array_equal(found.q[:, 0], [0.0, np.nan, 0.02, np.nan])
    assert_array_equal(found.gain[:, 0], [90.0, -np.inf, 92.0, -np.inf])
    assert found.num_tested.tolist() == [90, 100, 92, 0]
    nobody = known._misfit(misfit_facts(joint), range(1, 2), measured[1:2])
    assert np.isnan(nobody.q).all()


def test_without_a_joint_system_there_is_no_test():
    found = known._misfit(misfit_facts(None), range(4), np.array([True, True, True, False]))
    assert np.isnan(found.q).all()
    assert found.num_tested.tolist() == [100, 100, 100, 0]
    excluded, no_columns = (STATUS_CODES[each] for each in (MisfitStatus.EXCLUDED, MisfitStatus.NO_COLUMNS))
    assert found.status[:, 0].tolist() == [excluded, excluded, excluded, no_columns]
