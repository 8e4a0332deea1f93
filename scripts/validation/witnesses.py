"""What other scripts measured of the witnesses outside of the image: a section of docs/validation.md, by hand."""

from __future__ import annotations

from typing import Final

from scripts.validation.markdown import table

_HEADER: Final = ("witness", "size, simulated", "size, photos", "power", "script")
_ROWS: Final = (
    (
        "pairs (`verdict_outside`)",
        "0 of 144 images; 0 of 377 of folded buildings and their right twins",
        "0 of 563 healthy images (upper end 0.7 %), 0 of 78 others",
        (
            "one camera turned by 1 degree: 58 of 83 on photos; by 0.3 degrees: 18 of 83; shifted by 3 % of the depth: "
            "76 of 83"
        ),
        "`scripts/study_pairs.py`",
    ),
    (
        "pairs (finding `contradicted_pairs`)",
        "0 of 12 models",
        "1 of 26 models",
        "4 of 4 folds, and 2 of their 4 right twins too",
        "`scripts/study_pairs.py`",
    ),
    (
        "fold, model alone (finding)",
        "1 of 18 right models",
        "2 of 5 right models",
        "3 of 18 folds",
        "`scripts/study_folds.py`",
    ),
    (
        "another reconstruction (`check --baseline`)",
        "passes the right twins of the tests",
        "0 of 355 healthy images mapped twice (upper end 1.1 %)",
        "18 of 18 folds",
        "`scripts/study_folds.py`",
    ),
    (
        "standard deviations of poses (`--covariance`)",
        (
            "mean square of error / sd, rotation and centre together (1 is right): 1.10 Gaussian, 1.23 Laplace, 1.36 "
            "noise by track"
        ),
        "real errors are 3 to 4 x as large ([realtruth.md](realtruth.md))",
        "",
        "`scripts/study_poses.py`",
    ),
    (
        "connectivity (findings)",
        "exact: a graph",
        "6 of 53 public models in parts, 9 weakly joined; which are wrong is not known",
        "exact",
        "tests",
    ),
    ("rigs (finding)", "constructed models", "no public model claims a rig of several images", "constructed", "tests"),
    (
        "reference (`verdict_outside`)",
        "0 of 216 images",
        "1 of 196 images beside measured poses: it leaves undetermined",
        "one camera turned by 3 degrees or shifted by 15 % of the depth: 114 of 114; by 1 degree: 2 of 114",
        "`scripts/study_references.py`",
    ),
    (
        "priors (`verdict_outside`)",
        "16 of 12,960 images",
        "not counted: they leave undetermined",
        "off by 8 sd: 720 of 720; by 5 sd: 508; by 3 sd: 98",
        "`scripts/study_references.py`",
    ),
)


def witnesses_section() -> str:
    """Return the section: size and power of each witness, and the script that measures it."""
    words = (
        "## Witnesses outside of the image\n\nMeasured by scripts of their own, not by this one;"
        "\n[witnesses.md](witnesses.md) has their tables, and what a healthy image of a photo is."
    )
    return f"{words}\n\n{table(_HEADER, _ROWS)}"
