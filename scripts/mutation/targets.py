"""Where it is decided, and which tests have to notice a change there; and mutants that once survived, by name."""

from __future__ import annotations

from typing import Final

from scripts.mutation.mutants import Named, Target

DECISION: Final = tuple(f"unit/test_decision_{name}.py" for name in ("table", "reasons", "severity", "cause"))
NUMBERS: Final = ("unit/test_decision_numbers.py",)
LIMITS: Final = ("unit/test_consistency_limits.py", "unit/test_consistency.py")
ROUNDS: Final = ("unit/test_joint_rounds.py", "unit/test_joint_group.py")
SUSPECTS: Final = ("unit/test_suspects.py",)
GATE: Final = ("unit/test_gate.py::test_limits_of_a_scene_that_is_lost_are_not_met",)
BANDS: Final = ("unit/test_gate_bands.py",)
FINISHED: Final = tuple(
    f"unit/test_store.py::test_{name}"
    for name in (
        "a_model_of_other_settings_is_unfinished_where_nothing_else_says_which_they_were",
        "a_model_is_finished_with_observations_only_where_they_are_there",
    )
)
NO_SCALE: Final = ("unit/test_keypoint_scale_noise.py::test_too_few_tracks_are_not_fitted",)

_COLUMNS: Final = "unit/test_image_columns.py"
_SAME_TABLE: Final = f"{_COLUMNS}::test_the_table_says_what_each_image_says"
_REFERENCE: Final = "unit/test_witness_reference.py"

TARGETS: Final = (
    Target(
        "audit/decision/decide.py",
        (*DECISION, "unit/test_superfluous_parameters.py", "unit/test_decision_outside.py"),
    ),
    Target("audit/decision/members.py", DECISION),
    Target(
        "audit/decision/camera.py",
        DECISION,
        ("judge_camera", "material_steps", "step_text", "pose_alone", "_MOST"),
    ),
    Target("audit/decision/outside.py", ("unit/test_decision_outside.py",)),
    Target("audit/witnesses/pairs.py", ("unit/test_witness_pairs.py",), ("contradiction_p", "_statement")),
    Target("audit/witnesses/reference.py", (f"{_REFERENCE}::test_the_larger_share_of_a_limit_counts",), ("statement",)),
    Target(
        "audit/witnesses/priors.py",
        ("unit/test_prior_laws.py",),
        ("_by_covariance", "hotelling_p", "prior_p", "spread_p", "_statement"),
    ),
    Target(
        "audit/table/witnesses.py",
        ("unit/test_decision_outside.py",),
        ("WitnessWords.may_reject", "wilson_upper", "MAX_FALSE_ALARMS"),
    ),
    Target(
        "audit/decision/misfit.py",
        DECISION,
        (
            *("decide_misfits", "are_worth_nothing", "named_causes", "judge_misfit", "_too_few_tested", "_not_tested"),
            *("_worthless", "_shared", "_causes", "MisfitDecisions.largest_px", "MisfitDecisions.untested"),
            *("MisfitDecisions._also", "MisfitDecisions.effect_text", "_SHIFTS", "_SAYS_NOTHING"),
        ),
    ),
    Target("reports/compare/pose_limits.py", ("unit/test_pose_limits.py",), ("pose_limits", "PoseLimit.passed")),
    Target("reports/export/selection.py", ("unit/test_pose_limits.py",), ("known_to",)),
    Target("audit/decision/rejections.py", ("unit/test_rejections.py",)),
    Target("audit/decision/triage.py", ("unit/test_decision_triage.py",)),
    Target("audit/decision/severity.py", DECISION, ("severities_of", "worth_severities", "_ALWAYS_HARD")),
    Target(
        "audit/decision/diagnostics.py",
        DECISION,
        ("OwnDiagnostics.largest",),
    ),
    Target(
        "audit/decision/judged.py",
        (
            *DECISION,
            "unit/test_decision_outside.py",
            f"{_COLUMNS}::test_a_decision_does_not_depend_on_the_images_beside",
        ),
        ("Said.only", "Judged.of", "Judged.of_those", "say", "_at", "said_of"),
    ),
    Target(
        "audit/decision/decisions.py",
        (*DECISION, f"{_COLUMNS}::test_a_decision_does_not_depend_on_the_images_beside"),
        ("Decision.under", "deciders", "Decisions.under", "Decisions.rejects", "Decisions.decision"),
    ),
    Target(
        "audit/decision/columns.py",
        (f"{_COLUMNS}::test_each_sentence_is_told_once_of_each_image", _SAME_TABLE),
        ("_policy_reasons", "_offsets"),
    ),
    Target(
        "audit/engine/known.py",
        ("unit/test_engine_known.py", f"{_COLUMNS}::test_what_decides_is_that_of_each_image"),
        ("_steps", "_unusable", "_parts", "_own", "_camera", "_sd_k1", "_misfit"),
    ),
    Target(
        "audit/table/words.py",
        DECISION,
        ("VERDICT_ORDER", "POLICIES", "LENS_GROUPS", "SEVERITY_ORDER", "is_remark", "strongest", "verdict_under"),
    ),
    Target(
        "audit/table/thresholds.py",
        (*DECISION, *NUMBERS),
        (
            *("ALPHA", "MIN_KS_DISTANCE", "MIN_OBSERVATIONS", "MAX_POSE_OFFSET_PX", "MIN_FOCAL_OVER_SIZE"),
            *("MAX_FOCAL_OVER_SIZE", "MAX_SD_FOCAL_REL", "MIN_K1_SDS", "MIN_COVERAGE", "MIN_OCCUPIED_CELLS"),
            *("MAX_NOISE_DISTANCE", "KS_CRITICAL", "MIN_OWN_STEP_SDS", "EXACT_SHARE", "HALF_PIXEL_SHIFT_PX"),
            *("HARD_WORTH_DEG", "HARD_WORTH_FOCAL_REL", "WEAK_WORTH_DEG", "WEAK_WORTH_FOCAL_REL"),
            *("MIN_SHIFT_WORTH_CENTRE", "MIN_SHIFT_WORTH_FOCAL_REL", "MAX_WORTHLESS_TAUS", "effect_px"),
        ),
    ),
    Target(
        "audit/engine/jointly.py",
        NUMBERS,
        (
            *("misfit_diagnostics", "untested_misfit", "_group", "consistency_diagnostics", "own_diagnostics"),
            *("gains_of", "joint_camera", "_IMPLIED_COLUMNS", "implied_by_camera"),
        ),
    ),
    Target("audit/engine/model.py", NUMBERS, ("ModelAuditor.shared_misfit",)),
    Target("audit/engine/camera.py", NUMBERS, ("is_advisable", "images_advice")),
    Target(
        "audit/consistency/image.py", LIMITS, ("ConsistencyLimits", "_judged", "_exceeds", "_is_tail", "half_pixel")
    ),
    Target(
        "audit/consistency/together.py",
        ("unit/test_kernel_consistency.py",),
        ("clear_images", "_cameras", "_is_clear", "_CLEAR"),
    ),
    Target(
        "audit/consistency/model.py",
        LIMITS,
        ("model_consistency", "_without_lone_scales", "_pixel_convention", "_common_cause"),
    ),
    Target("audit/joint/own.py", NUMBERS, ("CameraStep.is_material", "CameraStep.agreed")),
    Target(
        "audit/joint/group_test.py",
        ROUNDS,
        (
            *("test_group", "group_root", "_roots", "_judged", "answers", "_quadratic_forms", "_cholesky"),
            *("KEPT_EIGENVALUE", "MIN_OBSERVATIONS_PER_RANK"),
            "MAX_EFFECT_OVER_RMS",
        ),
    ),
    Target("audit/engine/quality.py", SUSPECTS, ("_SUSPECT_FROM", "suspects_of")),
    Target(
        "audit/joint/misfit.py",
        ROUNDS,
        (
            *("MAX_ROUNDS", "_INCLUDE_FROM_PX", "_SHARE_OF_LARGEST", "_MOST_SUSPECTS"),
            *("joint_misfit", "included_from", "_nothing", "_Rounds.__init__"),
            *(
                "_Rounds.run",
                "_Rounds._next",
                "_Rounds._test",
                "_Rounds._significant",
                "_Rounds._effects",
                "_Rounds._include",
            ),
            *("_Rounds._touched", "_Rounds._result", "_Rounds._cause"),
        ),
    ),
)

# What survived before there was a decision table (issue of the vocabulary), in the words of today's code.
NAMED: Final = (
    Named(
        "an image is rejected for a significant misfit that is not material",
        "audit/decision/misfit.py",
        "material = open_ & found.material.any(axis=1)",
        "material = open_ & (found.cause >= 0)",
        DECISION,
    ),
    Named(
        "a camera is named as a whole beside images that are accepted",
        "audit/decision/misfit.py",
        "rejected = material & ~worthless",
        "rejected = (material & ~worthless) | (open_ & shared)",
        DECISION,
    ),
    Named(
        "verdict_pose ignores its setting",
        "audit/decision/members.py",
        "limit = settings.pose_offset_threshold_px",
        "limit = 0.5",
        DECISION,
    ),
    Named(
        "the cause is taken from groups that are not material",
        "audit/decision/misfit.py",
        "cause = named_causes(measured, candidates)",
        "cause = named_causes(measured, significant)",
        DECISION,
    ),
    Named(
        "the joint test's cause is taken from groups that are not material",
        "audit/joint/misfit.py",
        "return max(material or significant, key=",
        "return max(significant, key=",
        ROUNDS,
    ),
    Named(
        "fields are admitted from 0.3 px on",
        "audit/joint/misfit.py",
        "_INCLUDE_FROM_PX: Final = 0.1",
        "_INCLUDE_FROM_PX: Final = 0.3",
        ROUNDS,
    ),
    Named(
        "fields are admitted from 0.1 px on whatever tau is",
        "audit/joint/misfit.py",
        "np.fmin(_INCLUDE_FROM_PX, 0.5 * tau_px)",
        "np.full(tau_px.shape, _INCLUDE_FROM_PX)",
        ROUNDS,
    ),
    Named(
        "fields are admitted that have a fifth of the largest",
        "audit/joint/misfit.py",
        "_SHARE_OF_LARGEST: Final = 0.5",
        "_SHARE_OF_LARGEST: Final = 0.2",
        ROUNDS,
    ),
    Named(
        "fields are admitted though most images would be",
        "audit/joint/misfit.py",
        "most = 2 * np.count_nonzero(new | (self._round >= 0)) > np.count_nonzero(self._tested)",
        "most = False",
        ROUNDS,
    ),
    Named(
        "the page takes tau in sigma for unknown",
        "reports/html/page.py",
        "effect_px(str(effect), sigma_px)",
        "effect_px(str(effect), None)",
        NUMBERS,
    ),
    Named(
        "explain takes tau in sigma for unknown",
        "audit/cli/recompute.py",
        "effect_px(effect, sigma_px)",
        "effect_px(effect, None)",
        NUMBERS,
    ),
    Named(
        "tau in sigma is taken for px",
        "audit/table/thresholds.py",
        'float(min_effect.removesuffix("sigma")) * sigma_px',
        'float(min_effect.removesuffix("sigma"))',
        (*DECISION, *NUMBERS),
    ),
    Named(
        "a shared camera of one image",
        "audit/engine/model.py",
        "len(camera.image_idxs) < 2",
        "len(camera.image_idxs) < 1",
        NUMBERS,
    ),
    Named(
        "the noise of a camera's images is their largest",
        "audit/joint/own.py",
        "median_of(observations.sigma_px, own)",
        "float(np.max(observations.sigma_px[own]))",
        ("unit/test_joint_own_noise.py",),
    ),
    Named(
        "tau of a camera is the largest of its images",
        "audit/engine/camera.py",
        "_median(tau_px[group.image_idxs])",
        "float(np.max(tau_px[group.image_idxs]))",
        NUMBERS,
    ),
    Named(
        "keypoints whose scale explains nothing are weighted by it",
        "audit/noise/keypoint.py",
        "(power.gamma if math.isfinite(power.gamma) else 0.0)",
        "(power.gamma if math.isfinite(power.gamma) else 1.0)",
        NO_SCALE,
    ),
    Named(
        "the joint test leaves out cameras that the decision accepts",
        "audit/joint/own.py",
        "> MIN_OWN_STEP_SDS * self.sd) & (self.sd > 0)",
        "> 4.0 * self.sd) & (self.sd > 0)",
        NUMBERS,
    ),
    Named(
        "only the weighted step has to be material",
        "audit/joint/own.py",
        "gain_px = min(self.own_step_px, self.plain_step_px)",
        "gain_px = self.own_step_px",
        NUMBERS,
    ),
    Named(
        "images may move ten times as far between two runs",
        "reports/compare/gate_policy.py",
        "pose_centre: _Rise = 0.02",
        "pose_centre: _Rise = 0.2",
        BANDS,
    ),
    Named(
        "a scene that is lost meets its limits",
        "reports/compare/gate.py",
        "own or _NOTHING",
        "own or ScopeNumbers(1, 1, 0, 0, {}, 1.0, 1.0, 1.0)",
        GATE,
    ),
    Named(
        "an error that was seen before counts whole when it is found",
        "reports/compare/comparison.py",
        "seen=(misfit, pose, of_camera)",
        "seen=(misfit * is_misfit, pose, of_camera)",
        BANDS,
    ),
    Named(
        "a model that was audited with other settings is finished",
        "reports/run_folder/store.py",
        "(part.version, part.config, part.labels) != (self._settings.version, self._config(), _labels(ref))",
        "(part.version, part.labels) != (self._settings.version, _labels(ref))",
        FINISHED,
    ),
    Named(
        "a model without the observations that are asked for is finished",
        "reports/run_folder/store.py",
        "or not model.parts.keys() >= set(self._wanted)",
        "",
        FINISHED,
    ),
    Named(
        "one model with limits is audited in the command's own process",
        "audit/schedule/runner.py",
        "elif len(plan) == 1 and plan[0].num_processes == 1 and not is_limited:",
        "elif len(plan) == 1 and plan[0].num_processes == 1:",
        ("unit/test_runner.py::test_a_model_with_limits_on_memory_or_time_is_watched_from_another_process",),
    ),
)
