"""What did witnesses outside of the images say? Counted by model, with the images that they speak against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from sfm_audit.audit.table.witnesses import WITNESSES, Witness
from sfm_audit.audit.table.words import WITNESS_CODES
from sfm_audit.reports.run_folder.reader import Row
from sfm_audit.reports.text.reasons import reasons_of
from sfm_audit.reports.text.wording import plain

MAX_MODELS: Final = 100
MAX_NAMED: Final = 12  # images that a witness speaks against
_MODEL: Final = ("dataset", "scene", "component", "model_path")
_Key = tuple[Any, ...]


@dataclass(slots=True)
class _Said:
    """Of how many images of a model a witness spoke, and against which; the first ones by id and name."""

    num_images: int = 0
    num_against: int = 0
    named: list[tuple[int | None, str]] = field(default_factory=list)


@dataclass(slots=True)
class Statements:
    """What witnesses said, by model and witness."""

    said: dict[_Key, dict[str, _Said]] = field(default_factory=dict)

    def add(self, row: Row) -> None:
        """Count a row of the images table."""
        spoke = row.get("witnesses") or ()
        if not spoke:
            return
        told = row.get("reason_details") or reasons_of(row)
        against = {reason["code"] for reason in told}
        of_model = self.said.setdefault(_key(row), {})
        for name in spoke:
            one = of_model.setdefault(name, _Said())
            one.num_images += 1
            if WITNESS_CODES.get(name) in against:
                one.num_against += 1
                if len(one.named) < MAX_NAMED:
                    one.named.append((row["image_id"], row["image_name"]))


def witnesses_of(statements: Statements, models: Sequence[Row], rows: Sequence[Row]) -> dict[str, Any]:
    """Return what the page shows of the models that a witness was asked about.

    Parameters
    ----------
    rows : of the page's table, which the names of images open

    Returns
    -------
    dict
        models: those with the most images spoken against first, of ``num_models``.    questions: of the witnesses.
    """
    numbers = {(*_key(row), row["image_id"]): i for i, row in enumerate(rows)}
    several = len({model["dataset"] for model in models}) > 1
    shown = [_model(statements.said.get(_key(model), {}), model, numbers, several=several) for model in models]
    shown = [model for model in shown if model["witnesses"]]
    shown.sort(key=lambda model: -model["num_against"])
    there = {line["name"] for model in shown for line in model["witnesses"]}
    questions = [(str(name), words.question) for name, words in WITNESSES.items() if name in there]
    return {"models": shown[:MAX_MODELS], "num_models": len(shown), "questions": questions}


def _key(row: Row) -> _Key:
    return tuple(row[name] for name in _MODEL)


def _model(said: Mapping[str, _Said], model: Row, numbers: Mapping[_Key, int], *, several: bool) -> dict[str, Any]:
    findings = model["findings"] or []
    lines = []
    for name in dict.fromkeys((*map(str, Witness), *said, *(model["witnesses"] or ()))):
        codes = WITNESSES[Witness(name)].findings if name in set(Witness) else ()  # another version has others
        told = [(plain(str(each["code"])), plain(each["text"])) for each in findings if each["code"] in codes]
        one = said.get(name, _Said())
        if told or one.num_images or name in (model["witnesses"] or ()):
            named = [(plain(image), numbers.get((*_key(model), image_id))) for image_id, image in one.named]
            lines.append(
                {
                    "name": plain(name),
                    "num_images": one.num_images,
                    "num_against": one.num_against,
                    "named": named,
                    "findings": told,
                }
            )
    dataset = f"{model['dataset']}/" if several else ""
    return {
        "place": plain(f"{dataset}{model['scene']}/{model['component']}"),
        "num_images": model["num_images"] or 0,
        "num_against": sum(line["num_against"] for line in lines),
        "witnesses": lines,
    }
