"""Do compiled kernels and numpy say the same? Both audit the same models, all columns of all tables are compared.

    scripts/compare_paths.py            the corpus of real models where it is, simulated and damaged models
    scripts/compare_paths.py --write    and put the table into docs/kernels.md
    scripts/compare_paths.py --quick    a handful of models

Texts, verdicts, counts and what is null must be equal. Numbers may differ by 1e-9 of the larger of the two (by 5e-6
where a singular value may lie at the rank threshold, misfits, and in what the joint system solves for), or of a ten
thousandth of the column's median where a number is near zero by cancelling (a mean residual, a correlation). What is
badly conditioned (a principal point that nothing fixes) differs by more whenever the order of a sum changes: there the
measure is by how much numpy's own result moves when the axes of the world are exchanged, points stand in another order,
and coordinates move by a unit in the last place. A hundred times that is allowed, in the digits of a text too, and the
table counts such values. Exit code 1 where something differs by more, or where there are no compiled kernels.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

ROOT: Final = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from scripts.fuzzing import kernel_models as made  # noqa: E402 - the folders that hold it are on the path only now
from sfm_audit.audit.config import AuditConfig  # noqa: E402
from sfm_audit.audit.engine.model import ModelAuditor  # noqa: E402
from sfm_audit.audit.engine.tables import ModelAudit  # noqa: E402
from sfm_audit.audit.kernels import kernels_in_use, numpy_only, path_taken  # noqa: E402
from sfm_audit.loaders import LoadError, open_model  # noqa: E402
from sfm_audit.loaders.model import SparseModel  # noqa: E402

PAGE: Final = ROOT / "docs" / "kernels.md"
START, END = "<!-- made by scripts/compare_paths.py -->", "<!-- end of what it makes -->"
RTOL: Final = 1e-9
AT_THE_RANK: Final = 5e-6
"""Of misfits: a singular value that lies at the rank threshold is cut off in one way or the other."""
OF_A_SOLUTION: Final = ("misfit_", "own_", "implied_")
"""Columns that come from a system of equations, whose condition takes digits away: they have 5e-6."""
NEAR_ZERO: Final = 1e-4
SMALLEST: Final = 1e-5
"""Numbers below are compared as if they were that large."""
OF_THE_ORDER_OF_ONE: Final = ("skewness", "kurtosis")
"""Columns whose zero is a sum of cubes that cancel: they are compared as if they were 1."""
OWN_ROUNDING: Final = 100.0
MEANINGLESS: Final = 1e-3
"""A number of which numpy's own rounding moves more than that is rounding: whether it is null may differ too."""

_WORD: Final = r"\b(null|number|nan|inf)\b"
NUMBER: Final = re.compile(rf"[-+]?\d+(\.\d+)?(e[-+]?\d+)?|None|'{_WORD}'|{_WORD}")
TABLES: Final = ("images", "cameras", "models", "observations")
QUICK_CORPUS: Final = 2


@dataclass(slots=True)
class Compared:
    """What the models of one kind gave.

    num_equal: values equal to the last bit.    num_beyond: by more than 1e-9, see above.
    worst: largest relative difference, and in which column of which model.
    """

    kind: str
    num_models: int = 0
    num_images: int = 0
    num_values: int = 0
    num_equal: int = 0
    num_beyond: int = 0
    worst: tuple[float, str] = (0.0, "")
    faults: list[str] = field(default_factory=list)

    def line(self) -> str:
        """Return a row of the table."""
        share = 100.0 * self.num_equal / max(1, self.num_values)
        worst = f"{self.worst[0]:.1e} ({self.worst[1].partition(' ')[0]})" if self.worst[0] else "0"
        counts = f"{self.num_models} | {self.num_images} | {self.num_values} | {share:.1f} % | {self.num_beyond}"
        return f"| {self.kind} | {counts} | {worst} | {len(self.faults)} |"


def tables_of(model: SparseModel) -> ModelAudit:
    """Audit a model with everything that has a column."""
    from threadpoolctl import threadpool_limits  # noqa: PLC0415

    with threadpool_limits(limits=1, user_api="blas"), np.errstate(all="ignore"):
        return ModelAuditor(model, AuditConfig(covariance=True)).tables(observations=True)


def nudged(model: SparseModel, seed: int = 5) -> SparseModel:
    """Return the same model for a mathematician: axes exchanged, points in another order, coordinates a last unit off.

    Exchanged axes change the order in which a point's coordinates in the camera are added up, whose terms may be large;
    points in another order that of the sums over them.
    """
    rng = np.random.default_rng(seed)

    def moved(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        with np.errstate(all="ignore"):
            out = np.where(rng.random(values.shape) < 0.5, np.nextafter(values, np.inf), np.nextafter(values, -np.inf))
        return np.where(np.isfinite(out), out, values)

    w, x, y, z = (
        0.5 * model.images.quat_cam_from_world_wxyz.T
    )  # times the inverse of (1, 1, 1, 1) / 2: x to y to z to x
    with np.errstate(all="ignore"):
        turned = np.column_stack([w + x + y + z, x - w - y + z, y - w - z + x, z - w - x + y])
    order = rng.permutation(len(model.points))
    place = np.append(np.argsort(order), -1)  # of a point that does not exist: -1 stays
    xyz = moved(np.roll(model.points.xyz_world, 1, axis=1))[order]
    xy, point_idx = moved(model.observations.xy_px), place[model.observations.point_idx]
    return replace(
        model,
        images=replace(model.images, quat_cam_from_world_wxyz=turned),
        observations=replace(model.observations, xy_px=xy, point_idx=point_idx),
        points=replace(model.points, xyz_world=xyz, stored_error_px=model.points.stored_error_px[order]),
    )


def compare(model: SparseModel, name: str, out: Compared) -> None:
    """Audit a model on both paths and compare all columns.

    One nudge may leave by chance what others move a thousand times as far: before something counts as a fault, the
    largest move of three is taken.
    """
    with numpy_only():
        expected, sensitive = tables_of(model), [tables_of(nudged(model, 5))]
    found = tables_of(model)
    told = _compared(name, (expected, found), sensitive, out.kind)
    if told.faults:
        with numpy_only():
            sensitive += [tables_of(nudged(model, seed)) for seed in (6, 7)]
        told = _compared(name, (expected, found), sensitive, out.kind)
    out.num_models += 1
    out.num_images += len(model.images)
    out.num_values += told.num_values
    out.num_equal += told.num_equal
    out.num_beyond += told.num_beyond
    out.worst = max(out.worst, told.worst)
    out.faults += told.faults


def _compared(name: str, both: tuple[ModelAudit, ModelAudit], nudged_ones: Sequence[ModelAudit], kind: str) -> Compared:
    out = Compared(kind)
    for table in TABLES:
        one, other, *others = (getattr(each, table) for each in (*both, *nudged_ones))
        if one.schema != other.schema or one.num_rows != other.num_rows:
            out.faults.append(f"{name}: {table} has other columns or rows")
            continue
        for column in one.column_names:
            columns = [split(each[column].to_pylist(), each[column].type) for each in (one, other, *others)]
            _compare_column(f"{column} of {name}", columns, out)
    return out


Column = tuple[list[Any], np.ndarray[Any, Any]]


def split(values: list[Any], kind: pa.DataType) -> Column:
    """Return a column's values without their numbers, and the numbers, null as NaN."""
    if pa.types.is_floating(kind):
        words = ["null" if value is None else "number" for value in values]
        return words, np.array([value for value in values if value is not None], dtype=float)
    numbers: list[float] = []

    def without(value: Any) -> Any:
        if isinstance(value, float):
            numbers.append(value)
            return "number"
        if isinstance(value, dict):
            return {key: without(each) for key, each in value.items()}
        return [without(each) for each in value] if isinstance(value, list) else value

    return [without(value) for value in values], np.array(numbers, dtype=float)


def _compare_column(where: str, columns: Sequence[Column], out: Compared) -> None:
    """Compare one column of both paths; the others are those of nudged models."""
    (words, a), (other_words, b), *nudged_ones = columns
    out.num_values += max(len(words), len(a))
    smallest = 1.0 if where.startswith(OF_THE_ORDER_OF_ONE) else SMALLEST
    own = max(
        float(np.max(relative_difference(a, c, smallest), initial=0.0)) if a.shape == c.shape else np.inf
        for _, c in nudged_ones
    )
    wrongs = [_other_words(words, other_words, None if own > MEANINGLESS else third) for third, _ in nudged_ones]
    wrong = None if None in wrongs else wrongs[0]
    if wrong is not None:
        out.faults.append(f"{where}: {words[wrong]!r} by numpy, {other_words[wrong]!r} by kernels")
        return
    if a.shape != b.shape:  # a null here or there, as numpy itself has it
        out.num_beyond += abs(len(a) - len(b))
        return
    off = relative_difference(a, b, smallest)
    out.num_equal += max(len(words) - len(a), 0) + int(np.count_nonzero(off == 0.0))
    if not off.any():
        return
    k = int(off.argmax())
    out.num_beyond += int(np.count_nonzero(off > RTOL))
    if off[k] > out.worst[0]:
        out.worst = (float(off[k]), where)
    if off[k] > max(AT_THE_RANK if where.startswith(OF_A_SOLUTION) else RTOL, OWN_ROUNDING * own):
        said = f"{where}: {a[k]!r} by numpy, {b[k]!r} by kernels, {off[k]:.1e}; numpy itself {own:.1e}"
        out.faults.append(f"{said} ({np.count_nonzero(off > RTOL)} of {len(a)} values)")


def _other_words(words: list[Any], others: list[Any], nudged_words: list[Any] | None) -> int | None:
    """Return the first row whose text is another one, None where all are equal.

    A number in it may be the neighbour of what numpy prints. Digits and nulls may differ in rows in which numpy's own
    rounding changes them; everywhere with None for those.
    """
    for k, (one, other) in enumerate(zip(words, others, strict=True)):
        if one == other:
            continue
        texts = repr(one), repr(other)
        same_but_digits = NUMBER.sub("#", texts[0]) == NUMBER.sub("#", texts[1])
        by_rounding = nudged_words is None or one != nudged_words[k]
        if not same_but_digits or not (by_rounding or _are_neighbours(*texts)):
            return k
    return None


def _are_neighbours(one: str, other: str) -> bool:
    """Whether numbers in two texts are the same or next to each other at the places that are printed."""
    pairs = zip((each[0] for each in NUMBER.finditer(one)), (each[0] for each in NUMBER.finditer(other)), strict=True)
    return all(a == b or _is_near(a, b) for a, b in pairs)


def _is_near(a: str, b: str) -> bool:
    """Whether both are printed numbers with places or an exponent, which counts have not, and neighbours."""
    printed = all("." in each or "e" in each for each in (a, b)) and a[-1].isdigit() and b[-1].isdigit()
    return printed and abs(float(a) - float(b)) <= 1.01 * max(_unit(a), _unit(b))


def _unit(number: str) -> float:
    """Return what one more in the last place of a printed number is."""
    mantissa, _, exponent = number.partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def relative_difference(
    a: np.ndarray[Any, Any], b: np.ndarray[Any, Any], smallest: float = SMALLEST
) -> np.ndarray[Any, Any]:
    """Return by how much numbers differ, in units of the larger, or of what is near zero in their column."""
    with np.errstate(all="ignore"):
        size = np.maximum(np.abs(a), np.abs(b))
        finite = size[np.isfinite(size)]
        floor = NEAR_ZERO * float(np.median(finite)) if finite.size else 0.0
        off = np.abs(a - b) / np.maximum(np.maximum(size, floor), smallest)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    return np.where(same, 0.0, np.where(np.isnan(off), np.inf, off))


def corpus_models(*, quick: bool) -> Iterator[tuple[str, SparseModel]]:
    """Yield the real models, where they are."""
    from corpus import CORPUS, corpus_models  # type: ignore[import-not-found] # noqa: PLC0415 - of tests/

    paths = corpus_models(more=True)
    if quick:
        paths = sorted(paths, key=lambda path: sum(each.stat().st_size for each in path.iterdir()))
        paths = paths[len(paths) // 4 :: max(1, len(paths) // 4)][:QUICK_CORPUS]
    for path in paths:
        try:
            yield str(path.relative_to(CORPUS)), open_model(str(path))
        except LoadError:
            continue


def lens_models(folder: Path, *, quick: bool) -> Iterator[tuple[str, SparseModel]]:
    """Yield simulated models of every lens, with images of no, one, few and many points."""
    rng = np.random.default_rng(1)
    for k, lens in enumerate(made.LENSES[::4] if quick else made.LENSES):
        numbers = (*rng.permutation(made.NUMBERS).tolist(), 400)
        for shared in (k % 2 == 0,) if quick else (False, True):
            model = made.lens_model(lens, rng, numbers, shared=shared)
            name = f"{lens.name}{' shared' * shared}"
            yield name, open_model(str(made.writer.write_binary(folder / name, model)))


def scenes(folder: Path, *, quick: bool) -> Iterator[tuple[str, SparseModel]]:
    """Yield simulated scenes: healthy, of one camera, with wrong images, with other planted defects."""
    from scripts.bench import simulate  # noqa: PLC0415
    from sfm_audit.audit.simulate.adjust import write_adjusted_model  # noqa: PLC0415
    from sfm_audit.audit.simulate.demo import demo_scene  # noqa: PLC0415
    from sfm_audit.audit.simulate.scene import simulate_scene  # noqa: PLC0415

    for kind in ("w",) if quick else ("b", "s", "w"):
        (folder / kind).mkdir()
        simulate(folder / kind, 8 if quick else 100, kind)
        yield kind, open_model(str(folder / kind))
    for seed in range(1 if quick else 8):
        scene = simulate_scene(demo_scene(seed), np.random.default_rng([seed, 1]))
        write_adjusted_model(scene, folder / str(seed))
        yield f"demo {seed}", open_model(str(folder / str(seed)))


def damaged_models(folder: Path, *, quick: bool) -> Iterator[tuple[str, SparseModel]]:
    """Yield models with odd numbers, as scripts/fuzz.py makes them, those that can be read."""
    for number in range(8 if quick else 400):
        case = made.model_case(7, number)
        (folder / str(number)).mkdir()
        made.write_case(case, folder / str(number))
        try:
            yield f"damaged {number}", open_model(str(folder / str(number)))
        except LoadError:
            continue


def compare_all(*, quick: bool, only: Sequence[str]) -> list[Compared]:
    """Compare all kinds of models; what differs is printed as it is found."""
    out = []
    with tempfile.TemporaryDirectory(prefix="paths-") as name:
        kinds = {
            "real": corpus_models(quick=quick),
            "simulated, every lens": lens_models(_folder(name, "lenses"), quick=quick),
            "simulated scenes": scenes(_folder(name, "scenes"), quick=quick),
            "damaged": damaged_models(_folder(name, "damaged"), quick=quick),
        }
        for kind, models in kinds.items():
            if only and not any(word in kind for word in only):
                continue
            found = Compared(kind)
            for model_name, model in models:
                known = len(found.faults)
                compare(model, model_name, found)
                for fault in found.faults[known:]:
                    print(f"  {fault}", flush=True)
            print(f"{found.line()} {found.worst[1]}", flush=True)
            out.append(found)
    return out


def _folder(root: str, name: str) -> Path:
    path = Path(root) / name
    path.mkdir()
    return path


HEAD: Final = (
    "| | models | images | values | equal to the last bit | beyond 1e-9 | largest relative difference | faults |"
)


def write(compared: Sequence[Compared]) -> None:
    """Put the table into docs/kernels.md."""
    lines = [HEAD, "|---|---:|---:|---:|---:|---:|---|---:|", *(each.line() for each in compared)]
    text = PAGE.read_text(encoding="utf-8")
    made_by = f"{START}\n{chr(10).join(lines)}\n{END}"
    PAGE.write_text(re.sub(f"{START}.*?{END}", lambda _: made_by, text, flags=re.DOTALL), encoding="utf-8")


def main() -> int:
    """Compare, print; return 1 where something differs by more than it may."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--write", action="store_true", help="put the table into docs/kernels.md")
    parser.add_argument("--only", action="append", default=[], metavar="WORD", help="kinds of models with this word")
    args = parser.parse_args()
    if not kernels_in_use():
        print(f"compare_paths: there are no compiled kernels to compare with ({path_taken().reason})")
        return 1
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    compared = compare_all(quick=args.quick, only=args.only)
    if args.write:
        write(compared)
    return 1 if any(each.faults for each in compared) else 0


if __name__ == "__main__":
    sys.exit(main())
