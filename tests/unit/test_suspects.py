"""Who is tested first: images whose camera does not explain their points as they are (method.md section 11)."""

from __future__ import annotations

import math
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_audit.audit import ModelAuditor
from sfm_audit.audit.engine import model as engine
from sfm_audit.audit.engine.quality import suspects_of
from sfm_audit.audit.joint import misfit as joint_room
from sfm_audit.audit.kernels.threads import threads
from sfm_audit.audit.misfit.outcome import MisfitTest, not_tested
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.noise import NoiseKind, NoiseSpec
from sfm_audit.audit.simulate.scene import SceneSpec, simulate_scene
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus

NUM, WRONG = 40, (12, 30)


def quality(px=0.0, p=0.9, group=MisfitGroup.RADIAL):
    tests = dict.fromkeys(GROUPS, not_tested(MisfitStatus.ABSORBED, 0))
    return SimpleNamespace(misfit=tests | {group: MisfitTest(p, px, 2, MisfitStatus.TESTED)})


@pytest.mark.parametrize(
    ("px", "p", "limit_px", "is_suspect"),
    [
        (0.0501, 1e-9, 0.1, True),
        (0.05, 1e-9, 0.1, False),
        (0.0501, 1e-9, math.nan, False),
        (0.0501, 0.0249, 0.1, True),  # q = 2 p: one of two images that can be tested
        (0.0501, 0.025, 0.1, False),
        (math.nan, math.nan, 0.1, False),
    ],
)
@pytest.mark.parametrize("group", [MisfitGroup.RADIAL, MisfitGroup.SMOOTH])
def test_suspects_are_significant_and_half_as_large_as_what_is_included(px, p, limit_px, is_suspect, group):
    found = suspects_of([None, quality(group=group), quality(px, p, group)], 0.05, np.array([0.1, 0.1, limit_px]))
    assert found.tolist() == [False, False, is_suspect]


@pytest.fixture(scope="module")
def model():
    spec = SceneSpec(
        num_images=NUM,
        points_per_image=200,
        noise=NoiseSpec(NoiseKind.GAUSSIAN, 0.5),
        defects=tuple(DefectSpec(image, DefectKind.RADIAL_K2, 0.8) for image in WRONG),
    )
    scene = simulate_scene(spec, np.random.default_rng(8))
    return sparse_model(scene, adjust_scene(scene))


def misfit_and_counts(model, monkeypatch):
    """An audit's misfit of all images, and how often each was tested in the joint system."""
    counts = np.zeros(len(model.images), dtype=int)
    original = joint_room._image_tests

    def counting(system, images, scores, alpha):
        counts[list(images)] += 1
        return original(system, images, scores, alpha)

    with monkeypatch.context() as patch:
        patch.setattr(joint_room, "_image_tests", counting)
        return ModelAuditor(model).joint.misfit, counts


def test_an_audit_asks_who_is_wrong_before_it_asks_everybody(model, monkeypatch):
    found, counts = misfit_and_counts(model, monkeypatch)
    monkeypatch.setattr(engine, "suspects_of", lambda qualities, *_: np.ones(len(qualities), dtype=bool))
    expected, all_at_once = misfit_and_counts(model, monkeypatch)
    assert np.flatnonzero(found.included).tolist() == np.flatnonzero(expected.included).tolist() == list(WRONG)
    assert counts.sum() <= NUM + 4
    assert all_at_once.sum() > NUM + 15
    assert found.cause == expected.cause
    np.testing.assert_array_equal(found.effect_px, expected.effect_px)


def test_two_threads_ask_for_the_quality_of_images_once(model, monkeypatch):
    asked = []
    original = engine.quality_of_images

    def counting(model, residuals, sigma_px, image_idxs, **options):
        asked.extend(image_idxs)
        return original(model, residuals, sigma_px, image_idxs, **options)

    monkeypatch.setattr(engine, "quality_of_images", counting)
    with threads(2):
        ModelAuditor(model).tables()
    assert sorted(asked) == list(range(NUM))


def test_an_auditor_goes_to_another_process_with_what_it_knows(model):
    auditor = ModelAuditor(model)
    known = auditor.quality
    there = pickle.loads(pickle.dumps(auditor))  # noqa: S301 - our own bytes
    assert [each.misfit for each in there.quality] == [each.misfit for each in known]
    assert there.joint.misfit.effect_px.tolist() == auditor.joint.misfit.effect_px.tolist()


def test_a_camera_with_one_image_and_its_image_try_a_lens_once(model, monkeypatch):
    tried = []
    original = engine.retested

    def counting(model, residuals, image_idx, camera):
        tried.append((image_idx, camera.model.name))
        return original(model, residuals, image_idx, camera)

    monkeypatch.setattr(engine, "retested", counting)
    tables = ModelAuditor(model).tables()
    assert {image for image, _ in tried} == set(WRONG)
    assert len(tried) == len(set(tried))
    advised = tables.images["advised_camera_model"].to_pylist()
    assert [advised[image] for image in WRONG] == [tables.cameras["advised_camera_model"][i].as_py() for i in WRONG]
    assert advised[WRONG[0]] == "RADIAL"
