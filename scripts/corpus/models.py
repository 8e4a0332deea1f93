"""A corpus as `sfm-audit run` and `diagnose --json` leave it: one record per model."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from sfm_audit.audit.table.words import Verdict


@dataclass(frozen=True, slots=True, eq=False)
class CorpusModel:
    """What is known of a model.

    name: scene, or scene/component where a scene has several.    images, cameras: data frames.    model: its row of
    ``RUN/models``.    found: of ``diagnose --json``; None where nothing speaks against the model.
    """

    name: str
    images: pd.DataFrame
    cameras: pd.DataFrame
    model: Mapping[str, Any]
    found: Mapping[str, Any] | None

    @property
    def dataset(self) -> str:
        """Name of the folder that it was found in."""
        return str(self.model["dataset"])

    @property
    def diagnoses(self) -> list[Mapping[str, Any]]:
        """The most urgent first."""
        return list(self.model["diagnoses"])

    def num(self, verdict: Verdict) -> int:
        """Images with this verdict."""
        return int((self.images.verdict == verdict).sum())


def models_of(run: Path, diagnosed: Sequence[Mapping[str, Any]]) -> tuple[list[CorpusModel], list[str]]:
    """Return the models of a run folder by name, and what could not be read in one line each.

    Parameters
    ----------
    diagnosed : ``models`` of ``diagnose --json``
    """
    images, cameras = (pd.read_parquet(run / table) for table in ("images", "cameras"))
    rows = pd.read_parquet(run / "models").to_dict("records")
    found = {str(each["model_path"]): each for each in diagnosed}
    count = Counter(row["scene"] for row in rows)
    models = [
        CorpusModel(
            _name(row, count),
            images[images.model_path == row["model_path"]],
            cameras[cameras.model_path == row["model_path"]],
            {str(name): value for name, value in row.items()},
            found.get(row["model_path"]),
        )
        for row in rows
    ]
    failures = json.loads((run / "run.json").read_bytes())["failures"]
    return sorted(models, key=lambda model: model.name), sorted(map(_unread, failures))


def _name(row: Mapping[Any, Any], count: Mapping[str, int]) -> str:
    return str(row["scene"]) if count[row["scene"]] == 1 else f"{row['scene']}/{row['component']}"


def _unread(failure: Mapping[str, Any]) -> str:
    """Return what could not be read without the place where the corpus lies on this machine."""
    location = str(failure["location"])
    name = Path(location).name
    return f"{name}: {str(failure['message']).replace(location, '').lstrip('/: ')}"
