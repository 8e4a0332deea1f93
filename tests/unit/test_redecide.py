"""A finished run decided again: its own settings change nothing, another policy gives what a run under it gives."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from decision_models import NUM_DEFECTIVE, SPEC, broken, defective, model_with

from sfm_audit.audit import AuditConfig, audit_model
from sfm_audit.audit.decision.from_table import FixedSettingError, MissingColumnError, redecide
from sfm_audit.audit.engine import image
from sfm_audit.audit.simulate.adjust import adjust_scene, sparse_model
from sfm_audit.audit.simulate.defects import DefectKind, DefectSpec
from sfm_audit.audit.simulate.demo import demo_scene
from sfm_audit.audit.simulate.scene import simulate_scene
from sfm_audit.audit.table import build_table, schema
from sfm_audit.audit.table.witnesses import Witness, WitnessStatement
from sfm_audit.audit.table.words import POLICIES, REASONS, SEVERITY_ORDER, UNUSABLE, WITNESS_CODES, ReasonCode, Verdict

RUN = AuditConfig()


def images_of(model, settings=RUN) -> pa.Table:
    """The images table of a run, as it is read from its folder."""
    buffer = io.BytesIO()
    pq.write_table(audit_model(model, settings).images, buffer)
    return pq.read_table(buffer)


def assert_same(found: pa.Table, wanted: pa.Table):
    """All columns, so that nothing that is not decided changes either."""
    assert found.schema == wanted.schema
    for name in wanted.column_names:
        assert repr(found.column(name).to_pylist()) == repr(wanted.column(name).to_pylist()), name  # NaN in lists


@pytest.fixture(scope="module")
def broken_model():
    return broken()


@pytest.fixture(scope="module")
def broken_images(broken_model):
    return images_of(broken_model)


@pytest.mark.parametrize("kind", DefectKind)
def test_the_runs_own_settings_change_nothing(kind):
    images = images_of(defective(kind))
    assert_same(redecide(images, RUN, run=RUN), images)


def test_the_demo_decides_as_it_did():
    scene = simulate_scene(demo_scene(1), np.random.default_rng([1, 1]))
    images = images_of(sparse_model(scene, adjust_scene(scene)))
    assert set(images.column("verdict").to_pylist()) == set(Verdict)
    assert_same(redecide(images, RUN, run=RUN), images)


def test_all_that_stands_in_the_way_is_kept(broken_images):
    codes = {item["code"] for row in broken_images.column("reason_details").to_pylist() for item in row}
    assert UNUSABLE | {"inconsistent"} <= codes
    assert codes & {"camera_not_optimal", "pose_not_optimal"}
    assert_same(redecide(broken_images, RUN, run=RUN), broken_images)


def test_what_makes_an_image_unusable_is_known_by_its_codes():
    source = Path(image.__file__).read_text()
    assert {ReasonCode[name] for name in re.findall(r"_unusable_reason\(ReasonCode\.(\w+)", source)} == UNUSABLE


def test_a_model_that_lies_behind_its_cameras_stays_there():
    model = model_with()
    images = replace(model.images, translation_cam_from_world=model.images.translation_cam_from_world - [0, 0, 100.0])
    table = images_of(replace(model, images=images))
    assert {item["code"] for row in table.column("reason_details").to_pylist() for item in row} == {"points_behind"}
    assert_same(redecide(table, RUN, run=RUN), table)


@pytest.mark.parametrize("policy", POLICIES)
def test_another_policy_is_a_run_under_it(policy, broken_model, broken_images):
    under = AuditConfig(policy=policy)
    assert_same(redecide(broken_images, under, run=RUN), images_of(broken_model, under))
    assert_same(redecide(images_of(broken_model, under), RUN, run=under), broken_images)


LIMITS = [
    {"min_observations": 140},
    {"max_noise_distance": 0.0},
    {"min_ks_distance": 0.9},
    {"min_focal_over_size": 0.63},
    {"max_focal_over_size": 0.6},
    {"max_sd_focal_rel": 1e-4},
    {"min_k1_sds": 1e4},
    {"min_coverage": 0.7},
    {"min_occupied_cells": 45},
]


@pytest.mark.parametrize("limit", LIMITS, ids=lambda limit: next(iter(limit)))
def test_another_limit_is_a_run_under_it(limit, broken_model, broken_images):
    under = AuditConfig(**limit)
    again = redecide(broken_images, under, run=RUN)
    assert_same(again, images_of(broken_model, under))
    assert again.column("reason_details").to_pylist() != broken_images.column("reason_details").to_pylist()


def test_fewer_observations_are_a_run_that_asks_for_fewer():
    model, under = defective(DefectKind.FEW_POINTS), AuditConfig(min_observations=10)
    images = images_of(model)
    assert images.column("verdict_pose").to_pylist()[:NUM_DEFECTIVE] == ["undetermined"] * NUM_DEFECTIVE
    again = redecide(images, under, run=RUN)
    assert "accepted" in again.column("verdict_pose").to_pylist()[:NUM_DEFECTIVE]
    assert_same(again, images_of(model, under))


@pytest.mark.parametrize("changed", [{"min_effect": "2px"}, {"min_effect": "9sigma"}, {"alpha": 1e-200}])
def test_a_misfit_that_matters_less_is_accepted_with_its_severity(changed):
    images = images_of(defective(DefectKind.ROLLING_SHUTTER))
    assert images.column("verdict_misfit").to_pylist()[:NUM_DEFECTIVE] == ["rejected"] * NUM_DEFECTIVE
    assert set(images.column("severity").to_pylist()[:NUM_DEFECTIVE]) <= set(SEVERITY_ORDER)
    again = redecide(images, AuditConfig(**changed), run=RUN)
    assert again.column("verdict_misfit").to_pylist()[:NUM_DEFECTIVE] == ["accepted"] * NUM_DEFECTIVE
    assert again.column("verdict").to_pylist() == ["accepted"] * SPEC.num_images
    assert again.column("severity").to_pylist() == [None] * SPEC.num_images
    assert again.column("advised_camera_model").to_pylist()[:NUM_DEFECTIVE] == [None] * NUM_DEFECTIVE


def test_advice_stays_where_nothing_changes_that_it_rests_on():
    images = images_of(defective(DefectKind.RADIAL_K2))
    assert any(images.column("advised_camera_model").to_pylist())
    same = redecide(images, AuditConfig(policy="paper", max_noise_distance=0.9), run=RUN)
    assert same.column("advised_camera_model").to_pylist() == images.column("advised_camera_model").to_pylist()
    larger = redecide(images, AuditConfig(min_effect="0.21px"), run=RUN)
    assert larger.column("verdict").to_pylist() == images.column("verdict").to_pylist()
    assert larger.column("advised_camera_model").to_pylist()[:NUM_DEFECTIVE] == [None] * NUM_DEFECTIVE


# a shared camera is named only while most images of its model are wrong


@pytest.fixture(scope="module")
def shared_model():
    spec = replace(SPEC, shared_camera=True)
    return model_with(*(DefectSpec(i, DefectKind.RADIAL_K2, 2.0) for i in range(12)), spec=spec, adjusted=True)


def test_a_shared_camera_is_named_while_most_images_are_wrong(shared_model):
    images = images_of(shared_model)
    named = [any(r.startswith("shared_camera") for r in row) for row in images.column("reasons").to_pylist()]
    assert all(named)
    assert_same(redecide(images, RUN, run=RUN), images)
    effects = sorted(images.column("misfit_px").to_pylist())
    middle = f"{0.5 * (effects[6] + effects[7]):.6f}px"
    again = redecide(images, AuditConfig(min_effect=middle), run=RUN)
    assert again.column("verdict_misfit").to_pylist().count("rejected") == 5
    assert not any(r.startswith("shared_camera") for row in again.column("reasons").to_pylist() for r in row)


# what cannot be done


@pytest.mark.parametrize(
    ("setting", "changes"),
    [
        ("noise", {"noise": "constant"}),
        ("points", {"noise": "constant", "points": "independent"}),
        ("min_track_length", {"min_track_length": 4}),
        ("min_track_eigenvalue", {"min_track_eigenvalue": 0.1}),
        ("grid", {"grid": 4}),
        ("min_effect", {"min_effect": "0.19px"}),
        ("min_effect", {"min_effect": "0.1sigma"}),
    ],
)
def test_what_changes_the_measurements_needs_another_run(setting, changes, broken_images):
    wanted = AuditConfig(**changes)
    run = RUN if setting != "points" else AuditConfig(noise="constant")
    with pytest.raises(FixedSettingError, match=f"^{setting} = ") as caught:
        redecide(broken_images, wanted, run=run)
    assert (caught.value.setting, caught.value.wanted) == (setting, getattr(wanted, setting))


def test_a_column_of_another_version_is_named(broken_images):
    with pytest.raises(MissingColumnError, match="gain_pose, misfit_details") as caught:
        redecide(broken_images.drop_columns(["misfit_details", "gain_pose"]), RUN, run=RUN)
    assert caught.value.columns == ("gain_pose", "misfit_details")


def test_what_witnesses_said_is_decided_again(broken_images):
    said = WitnessStatement(Witness.PAIRS, 0.75, 0.5, "6 of 8 pairs", 0.01)
    usable = [i for i, behind in enumerate(broken_images["num_inliers"].to_pylist()) if behind]
    silent, agrees, against = usable[-3:]
    column = [None] * broken_images.num_rows
    column[silent], column[agrees], column[against] = [], [replace(said, q=0.9)], [said]
    field = pa.schema([schema("images").field("testimonies")])
    fresh = build_table({"testimonies": column}, field).column(0)
    asked = broken_images.set_column(broken_images.column_names.index("testimonies"), field.field(0), fresh)
    again = redecide(asked, RUN, run=RUN)
    verdicts, makes = again["verdict_outside"].to_pylist(), REASONS[WITNESS_CODES[Witness.PAIRS]].makes
    assert (verdicts[silent], verdicts[agrees], verdicts[against]) == (None, "accepted", makes)
    assert set(verdicts[: usable[-3]]) == {None}
    assert "pairs_disagree: 6 of 8 pairs" in again["reasons"].to_pylist()[against]
    strict = redecide(asked, RUN.model_copy(update={"alpha": 0.009}), run=RUN)
    assert strict["verdict_outside"].to_pylist()[against] == "accepted"


def test_no_images_no_decisions():
    empty = schema("images").empty_table()
    assert_same(redecide(empty, RUN, run=RUN), empty)
