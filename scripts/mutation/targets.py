"""Where it is decided, and which tests have to notice a change there; and mutants that once survived, by name."""

from __future__ import annotations

from typing import Final

from scripts.mutation.mutants import Named, Target

DECISION: Final = tuple(f"unit/test_decision_{name}.py" for name in ("table", "reasons", "severity", "cause"))
NUMBERS: Final = ("unit/test_decision_numbers.py",)
CONSISTENCY: Final = ("unit/test_consistency_limits.py", "unit/test_consistency.py")
ROUNDS: Final = ("unit/test_joint_rounds.py",)

TARGETS: Final = (
    Target("audit/decision/decide.py", DECISION),
    Target("audit/decision/members.py", DECISION),
    Target(
        "audit/decision/camera.py",
        DECISION,
        ("judge_camera", "_judge_own", "material_step", "_not_optimal", "pose_alone", "_MOST"),
    ),
    Target(
        "audit/decision/misfit.py",
        DECISION,
        ("decide_misfit", "is_worth_nothing", "named_cause", "_SHIFTS", "_SAYS_NOTHING"),
    ),
    Target("audit/decision/severity.py", DECISION, ("severity_of", "worth_of", "worth_severity", "_ALWAYS_HARD")),
    Target(
        "audit/decision/diagnostics.py",
        DECISION,
        ("MisfitDiagnostics.num_lens_groups", "CameraDiagnostics.principal_point_outside", "OwnDiagnostics.largest"),
    ),
    Target(
        "audit/table/words.py",
        DECISION,
        ("VERDICT_ORDER", "POLICIES", "LENS_GROUPS", "SEVERITY_ORDER", "is_remark", "strongest", "verdict_under"),
    ),
)

NAMED: Final[tuple[Named, ...]] = ()
