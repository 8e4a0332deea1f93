"""Simulate the null distributions that audit/normality packages, or check the packaged ones.

make_null_tables.py [--draws N] [--seed N]     writes audit/normality/null_*.csv (about 5 minutes on one core)
make_null_tables.py --quick [--draws N]        re-simulates a little; exit code 1 where the packaged tables disagree
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy import special

from sfm_audit.audit.normality.null_tables import NullTable, modified_exponential, modified_normal, null_p

FloatArray = npt.NDArray[np.float64]
Draw = Callable[[np.random.Generator, int, int], FloatArray]

FOLDER = Path(__file__).resolve().parent.parent / "audit" / "normality"
SEED = 20240611
DRAWS = 200_000
# Sizes up to MANY_DRAWS_UP_TO get five times the draws: they are cheap.
MANY_DRAWS_UP_TO = 1000
SIZES = (*range(2, 11), 12, 14, 17, 20, 25, 30, 40, 50, 70, 100, 150, 200, 400, 1000, 3000, 10000, 20000)
# From here on the quantiles are smoothed over N by a cubic in 1 / sqrt(N), whose constant is the row N = inf.
# Measured: mean chi^2 per degree of freedom 0.9 for both tables, 1.2 and 1.4 with a square only.
SMOOTH_FROM = 12
SMOOTH_POWERS = 4
P_LEVELS = np.concatenate(
    (
        [0.999, 0.998, 0.995, 0.99],
        np.arange(98, 10, -2) / 100.0,
        np.arange(10, 2, -1) / 100.0,
        [0.025, 0.02, 0.016, 0.013, 0.01, 0.008, 0.006, 0.005, 0.004, 0.003, 0.0025, 0.002, 0.0016, 0.0013, 0.001],
        [0.0008, 0.0006, 0.0005, 0.0004, 0.0003, 0.00025, 0.0002, 0.00015, 0.0001],
    )
)
VALUES_PER_BATCH = 200_000
# --quick: sizes on and between the table's, and how many standard errors are too many (98 comparisons).
QUICK_DRAWS = 20_000
CHECK_SIZES = (4, 10, 20, 45, 120, 700, 4000)
CHECK_LEVELS = (0.9, 0.5, 0.2, 0.1, 0.05, 0.01, 0.003)
CHECK_SIGMAS = 4.5


def normal_distances(rng: np.random.Generator, num_values: int, draws: int) -> FloatArray:
    """Stephens' modified D of `draws` normal samples, centred by their mean and divided by their sd (ddof = 1)."""
    z = np.sort(rng.standard_normal((draws, num_values)), axis=1)
    z -= z.mean(axis=1, keepdims=True)
    z /= np.sqrt(np.einsum("ij,ij->i", z, z) / (num_values - 1))[:, None]
    return modified_normal(_distances(special.ndtr(z)), num_values)


def exponential_distances(rng: np.random.Generator, num_values: int, draws: int) -> FloatArray:
    """Stephens' modified D of `draws` exponential samples, divided by their mean."""
    t = np.sort(rng.standard_exponential((draws, num_values)), axis=1)
    t /= -t.mean(axis=1, keepdims=True)
    return modified_exponential(_distances(-np.expm1(t)), num_values)


def _distances(cdf_sorted: FloatArray) -> FloatArray:
    num_values = cdf_sorted.shape[1]
    excess = cdf_sorted - np.arange(1, num_values + 1) / num_values
    return np.asarray(np.maximum(excess.max(axis=1) + 1.0 / num_values, -excess.min(axis=1)))


TESTS: dict[NullTable, tuple[Draw, int]] = {
    NullTable.KS_FITTED: (normal_distances, 3),
    NullTable.KS_NORM: (exponential_distances, 2),
}


def simulate(table: NullTable, num_values: int, draws: int, seed: int) -> FloatArray:
    """Sorted statistics; every table and size has its own stream, so that a size can be added without moving others."""
    draw, _ = TESTS[table]
    rng = np.random.default_rng([seed, num_values, list(TESTS).index(table)])
    batch = max(1, VALUES_PER_BATCH // num_values)
    parts = [draw(rng, num_values, min(batch, draws - done)) for done in range(0, draws, batch)]
    return np.sort(np.concatenate(parts))


def smooth(sizes: FloatArray, quantiles: FloatArray, draws: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Quantiles (R, L) fitted over N >= SMOOTH_FROM by powers of 1 / sqrt(N); the smoothed ones and the limit."""
    chosen = sizes >= SMOOTH_FROM
    design = (sizes[chosen] ** -0.5)[:, None] ** np.arange(SMOOTH_POWERS)
    weight = np.sqrt(draws[chosen])[:, None]
    coefficients, *_ = np.linalg.lstsq(design * weight, quantiles[chosen] * weight, rcond=None)
    smoothed = quantiles.copy()
    smoothed[chosen] = design @ coefficients
    return smoothed, coefficients[0]


def make(table: NullTable, draws: int, seed: int) -> str:
    """Simulate one table and return its text."""
    sizes = np.array([size for size in SIZES if size >= TESTS[table][1]])
    num_draws = np.where(sizes <= MANY_DRAWS_UP_TO, 5 * draws, draws)
    rows = []
    for size, count in zip(sizes, num_draws, strict=True):
        statistics = simulate(table, int(size), int(count), seed)
        rows.append(np.quantile(statistics, 1.0 - P_LEVELS))
        print(f"{table.value} N = {size}: {count} draws, 5 % point {np.quantile(statistics, 0.95):.4f}", flush=True)
    smoothed, limit = smooth(sizes.astype(np.float64), np.array(rows), num_draws.astype(np.float64))
    origin = f"scripts/make_null_tables.py --seed {seed} --draws {draws} (x 5 for N <= {MANY_DRAWS_UP_TO})"
    return table_text(origin, [*map(str, sizes), "inf"], np.vstack((smoothed, limit)))


def table_text(origin: str, sizes: list[str], quantiles: FloatArray) -> str:
    """Return the file: where it is from, p of each column, one row of quantiles for each sample size."""
    lines = [
        f"# {origin}",
        "# upper quantiles of the modified statistic; first row: p, first column: N",
        "0," + ",".join(f"{p:g}" for p in P_LEVELS),
    ]
    for size, row in zip(sizes, quantiles, strict=True):
        if np.any(np.diff(row) <= 0.0):
            message = f"quantiles do not increase at N = {size}: more draws are needed ({origin})"
            raise ValueError(message)
        lines.append(f"{size}," + ",".join(f"{quantile:.5f}" for quantile in row))
    return "\n".join(lines) + "\n"


def disagreements(table: NullTable, draws: int, seed: int) -> list[str]:
    """What is wrong with a packaged table: a small simulation of another seed, against Monte-Carlo error of both."""
    found = []
    for size in CHECK_SIZES:
        statistics = simulate(table, size, draws, seed)
        p_values = np.array([null_p(table, float(statistic), size) for statistic in statistics])
        for level in CHECK_LEVELS:
            share = np.count_nonzero(p_values <= level) / draws
            error = np.sqrt(level * (1.0 - level) * (1.0 / draws + 1.0 / DRAWS))
            if abs(share - level) > CHECK_SIGMAS * error:
                found.append(
                    f"{table.value} N = {size}: p <= {level} in {share:.5f} of {draws} draws, error {error:.5f}"
                )
    return found


def main() -> int:
    """Make the tables, or check them; 0 if all is well."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, help=f"{DRAWS} per sample size; with --quick {QUICK_DRAWS}")
    parser.add_argument("--seed", type=int, help=f"{SEED}; with --quick {SEED + 1}")
    parser.add_argument("--quick", action="store_true", help="check the packaged tables instead of writing them")
    args = parser.parse_args()
    if args.quick:
        draws, seed = args.draws or QUICK_DRAWS, args.seed or SEED + 1
        found = [line for table in TESTS for line in disagreements(table, draws, seed)]
        print(
            "\n".join(found)
            or f"the packaged tables agree with {draws} draws at N = {', '.join(map(str, CHECK_SIZES))}"
        )
        return 1 if found else 0
    for table in TESTS:
        text = make(table, args.draws or DRAWS, args.seed or SEED)
        (FOLDER / f"{table.value}.csv").write_text(text, encoding="ascii")
    return 0


if __name__ == "__main__":
    sys.exit(main())
