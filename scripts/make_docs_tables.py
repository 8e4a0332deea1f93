"""Write the pages of docs/ that are made from code; with --check, fail when they are not what would be written."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from sfm_audit.audit.config import AuditConfig
from sfm_audit.audit.table import TABLES, Column
from sfm_audit.audit.table.columns import GROUP_COLUMNS
from sfm_audit.audit.table.words import REASONS, Member, ReasonWords
from sfm_audit.loaders.model import FINDING_MEANINGS, FindingCode
from sfm_audit.reports.text.codes import codes_page

DOCS = Path(__file__).resolve().parents[1] / "docs"
TABLES_INTRODUCTION = """# Tables

Made from `audit/table/columns.py` by `scripts/make_docs_tables.py`; do not edit.

A run folder holds one Parquet file per model in each of `RUN/images`, `RUN/cameras` and `RUN/models`, and with
`--observations` in `RUN/observations`. `pandas.read_parquet(RUN + "/images")` reads all of them. A value that was not
computed is null, never a number that stands for it. The unit and the meaning of a column are also in the files, as
field metadata.
"""
HEADERS = {
    "images": "One row per registered image. method.md names the quantities; docs/verdicts.md explains the verdicts.",
    "cameras": (
        "One row per camera that has an image with inliers. The tests are pooled over all its images: poses profiled\n"
        "per image, intrinsics once, clustered by track. A camera with one image has that image's tests."
    ),
    "observations": "One row per inlier of an image, only with `--observations`.",
    "models": "One row per model. docs/findings.md explains the findings.",
    "calibration": (
        "One row per estimator, in the file `calibration.parquet` of `sfm-audit calibrate -o` (docs/calibrate.md).\n"
        "Where the correspondences determine no camera nearly everything is null; `reasons` says why."
    ),
    "calibration_residuals": (
        "One row per correspondence and estimator, in the file `residuals.parquet` of `sfm-audit calibrate -o`."
    ),
}
CONFIG_INTRODUCTION = """# Settings

Made from `audit/config.py` by `scripts/make_docs_tables.py`; do not edit.

`sfm-audit run PATH... -o RUN --config FILE.toml` reads settings by name from a TOML file, such as

```toml
noise = "constant"
alpha = 0.01
```

What the file leaves out keeps its default; options of the command line come before the file. An unknown name, a value
of the wrong kind, or settings that contradict each other are refused. A run folder holds the tables of one config:
another one needs another folder.
"""
FINDINGS_PAGE = """# Findings

Made from `loaders/model.py` by `scripts/make_docs_tables.py`; do not edit.

A model that can be read is audited, however inconsistent it is; what is inconsistent stands in the column `findings` of
`RUN/models`: a code, how many items it concerns, and one line for people. A model that cannot be read (a file is
missing, cut short, or not what it says) has no findings: it is a failure in `run.json`, one line on stderr, and exit
code 3. A code leads to its causes and what to do; `sfm-audit explain-code CODE` says the same.

"""
VERDICTS_PAGE = """# Verdicts

Made from `audit/table/words.py` and `audit/config.py` by `scripts/make_docs_tables.py`; do not edit.

Each question about an image has a verdict of its own: `accepted`, `rejected`, or `undetermined` where the image does
not say enough. Undetermined is no pass. null: the question was not asked.

| column | question | rejected | undetermined |
|---|---|---|---|
| `verdict_misfit` | Does the camera model hold? | in the joint test, a group has q < {alpha} *and* an effect above \
{min_effect} | none of radial, tangential, affine, principal_point could run; pose or camera wrong otherwise |
| `verdict_camera` | Do its own parameters sit at their optimum, do the parts belong together? | freeing them would \
gain more than {min_effect} and one moves by more than 5 sd; camera, pose, points and 2D points do not fit | the image \
takes no part in the joint system |
| `verdict_pose` | Is the pose at the optimum of the image's own residuals? | `pose_offset_px` > \
{pose_offset_threshold_px} px | fewer than {min_observations} inliers |
| `plausible` | Could this be a camera, and do the points say so? | focal length / longer side outside \
[{min_focal_over_size}, {max_focal_over_size}]; the distortion folds inside the image; the principal point lies \
outside | joint sd of f / f > {max_sd_focal_rel}; coverage < {min_coverage}; fewer than {min_occupied_cells} occupied \
cells; fewer than {min_observations} inliers |
| `verdict_noise` | Is the noise visibly another one than the noise model says? | `ks_stat` - 1.36 / sqrt(N) > \
{max_noise_distance} | fewer than {min_observations} standardised observations; no noise fitted |
| `verdict_ks` | Are the residuals the noise that the noise model says? (the paper's decision) | `ks_p` < {alpha} \
(with `min_ks_distance`: and D above it) | fewer than {min_observations} standardised observations; no noise fitted |
| `verdict_outside` | Do witnesses outside of the image agree (docs/witnesses.md)? | a witness disagrees that is \
known to be rarely wrong | another witness disagrees; null where no witness could say anything |

The numbers are defaults (docs/config.md). q: Holm over the groups of an image, then Benjamini-Hochberg over the images
of its model; nothing depends on other models. *Joint test*: shared points carry the field of a wrong image into its
sound neighbours, so every field is tested against everything that poses, cameras and points could take up, and the
fields of images that fail become free parameters before the others are tested again (docs/method.md, 11). Where more
than half of the tested images are wrong, a camera whose images together say so is named (`shared_camera`).

## Policies

`verdict` is what the policy of the run (`--policy`) makes of them:

| policy | decides |
|---|---|
| `standard` (default) | all but `verdict_ks`, which with thousands of observations rejects noise that is hardly odd |
| `camera` | `verdict_misfit`, `verdict_camera`, `verdict_pose`, `plausible`: the noise may have any distribution |
| `full` | all |
| `paper` | `verdict_ks` alone |

Rejected if any of them rejects; else undetermined if any of them is; else accepted. Questions that were not asked are
skipped.

`severity` says how bad a rejection is: **hard** where parts do not fit, the pose is off, the camera is implausible or
away from its optimum, or a misfit is worth more than 0.2 degrees or 1 % of the focal length; **weak** where only the
noise rejects, or a misfit is worth less than 0.02 degrees and 0.1 %; **medium** between.

## Reasons

`reasons` lists, for the verdicts of the policy, a code, a colon, and the number that triggered it. *Remarks* stand in
the same list and decide nothing: an accepted image may carry them. A code leads to its causes and what to do;
`sfm-audit explain-code CODE` says the same.

{reasons}

## What a verdict does not prove

- KS and `verdict_noise` judge the noise, misfit the camera. KS rejects a correct camera whose noise is not what the
  model of the noise says, and with few observations it accepts a wrong lens.
- An accepted image agrees with its own reconstruction. That cannot see symmetric mis-registration (a repeated facade
  matched to the wrong copy), global scale, or drift. Who can, with what input and how often: docs/witnesses.md.
- A pose that was adjusted together with its error is at its optimum: `verdict_pose` finds poses that were changed, or
  not adjusted, afterwards.
- Effects below `--min-effect` are no reason to reject, however significant they are; in the tables they stand all the
  same (`misfit_px`, `misfit_q`).
- A group that the camera model has already, as radial in FULL_OPENCV, is null: it could not be tested, which is no
  pass. Spherical cameras have no misfit test.
- Standard deviations of camera parameters are small still: real errors are two to five times as large
  (docs/realtruth.md). Those in columns that end in `_conditional` take the points as exact.
- What points and poses absorbed leaves no residual: a principal point 8 px off shows only as a finding
  (`implied_principal_point`).
- Accepted is no p-value: of correct images some are rejected too (docs/validation.md says how many).
"""


def table_page() -> str:
    """Return docs/tables.md."""
    parts = [TABLES_INTRODUCTION]
    for name, columns in TABLES.items():
        rows = [f"| `{c.name}` | {_arrow(str(c.type))} | {c.unit} | {_cell(_meaning(c))} |" for c in columns]
        table = "\n".join(["| column | type | unit | meaning |", "|---|---|---|---|", *rows])
        parts.append(f"## `{name}`\n\n{HEADERS[name]}\n\n{table}\n")
        if name == "images":
            parts += [_group(group, columns) for group, columns in GROUP_COLUMNS.items()]
    return "\n".join(parts)


def _group(name: str, columns: Sequence[Column]) -> str:
    rows = [f"| `{c.name}` | {_arrow(str(c.type))} | {c.unit} | {_cell(_meaning(c))} |" for c in columns]
    table = "\n".join(["| column | type | unit | meaning |", "|---|---|---|---|", *rows])
    return f"### `images`, only with `--{name}`\n\n{table}\n"


def config_page() -> str:
    """Return docs/config.md."""
    rows = [
        f"| `{name}` | `{field.default}` | {_cell(field.description or '')} |"
        for name, field in AuditConfig.model_fields.items()
    ]
    return "\n".join([CONFIG_INTRODUCTION, "| setting | default | meaning |", "|---|---|---|", *rows, ""])


def findings_page() -> str:
    """Return docs/findings.md."""
    rows = [f"| [`{code}`](codes.md#{code}-finding) | {_cell(FINDING_MEANINGS[code])} |" for code in FindingCode]
    return FINDINGS_PAGE + "\n".join(["| code | meaning |", "|---|---|", *rows, ""])


def verdicts_page() -> str:
    """Return docs/verdicts.md."""
    rows = [
        f"| [`{code}`](codes.md#{code}) | {_members(words)} | {_makes(words)} | {_cell(words.meaning)} |"
        for code, words in REASONS.items()
    ]
    reasons = "\n".join(
        ["| code | verdict | makes it | meaning: what stands after the colon |", "|---|---|---|---|", *rows]
    )
    return VERDICTS_PAGE.format(reasons=reasons, **AuditConfig().model_dump())


def _members(words: ReasonWords) -> str:
    return "all" if set(words.members) == set(Member) else ", ".join(f"`{member}`" for member in words.members)


def _makes(words: ReasonWords) -> str:
    made = "remark" if words.makes is None else str(words.makes)
    return f"{made}, {words.note}" if words.note else made


PAGES = {
    "tables.md": table_page,
    "config.md": config_page,
    "findings.md": findings_page,
    "codes.md": codes_page,
    "verdicts.md": verdicts_page,
}


def main() -> int:
    """Write or compare; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing, fail when a page is stale")
    check = parser.parse_args().check
    stale = 0
    for name, render in PAGES.items():
        path, page = DOCS / name, render()
        if not check:
            DOCS.mkdir(exist_ok=True)
            path.write_text(page, encoding="utf-8")
        elif not path.exists() or path.read_text(encoding="utf-8") != page:
            print(f"{path}: not what the code says; run scripts/make_docs_tables.py", file=sys.stderr)
            stale = 1
    return stale


def _meaning(column: Column) -> str:
    return f"{column.meaning}; gauge: {column.gauge}" if column.gauge else column.meaning


def _arrow(kind: str) -> str:
    if kind.startswith("dictionary<values=string"):
        return "text"
    return kind.replace("element: ", "").replace("double", "float64").replace("string", "text")


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    sys.exit(main())
