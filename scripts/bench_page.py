"""What scripts/bench.py measured of one model, as tables for docs/performance.md."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

KINDS: Final = {
    "b": "a camera per image",
    "s": "one camera for all",
    "w": "2 % of the images wrong",
    "t": "small models",
}
JOINT: Final = "joint step and joint test"
COMPILED, NUMPY = "audit, compiled kernels", "audit, numpy alone"
"""The two ways to audit: what `Measured.samples` calls them."""

STAGES: Final[Mapping[str, tuple[int, int]]] = {
    "imports": (0, 0),
    "read, check": (0, 0),
    "residuals": (136, 210),
    "consistency": (64, 300),
    "tracks, prior": (260, 730),
    "camera facts": (136, 7300),
    "cameras": (0, 0),
    "witnesses": (0, 0),
    JOINT: (300, 27_000),
    "noise, tests, decisions, rows": (80, 900),
}
"""Bytes and floating point operations per observation that a stage cannot do without (SIMPLE_RADIAL, tracks of 5).

read: the files, once. residuals: observation, index and point in, residual and Jacobians out. tracks: three passes over
the Jacobians; seven evaluations of the prior's likelihood. camera facts: the triangle of the Gram matrix of 8 nuisance
and 42 candidate columns and that of the meat. joint: 42 fields against the 8 columns of five views of each track, there
and back. noise, tests: two sorts, two transformations. What a stage costs once per image is not in here.
"""


@dataclass(frozen=True, slots=True)
class Sample:
    """One process. cpu, wall: s.    peak, early_peak: bytes, at the end and before the joint step.

    parts: CPU seconds by stage.
    """

    cpu: float
    wall: float
    peak: float
    parts: Mapping[str, float] = field(default_factory=dict)
    early_peak: float = 0.0

    @property
    def plain(self) -> float:
        """CPU of all stages but the joint ones and the imports."""
        return sum(seconds for name, seconds in self.parts.items() if name not in {JOINT, "imports"})


@dataclass(frozen=True, slots=True)
class Measured:
    """One model, or a folder of small ones. what: its size in words.    limit_s: see scripts/bench.py."""

    kind: str
    what: str
    samples: Mapping[str, Sequence[Sample]]
    limit_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def num_images(self) -> int:
        """As ``what`` says."""
        return int(self.what.split()[0])

    @property
    def loads(self) -> list[float]:
        """CPU seconds of pycolmap's load, by round."""
        return [sample.parts["load"] for sample in self.samples["pycolmap"]]

    def plain_ratio(self, path: str) -> float:
        """Audit without the joint step and imports / load, on one of both paths."""
        return statistics.median(own.plain / load for own, load in zip(self.samples[path], self.loads, strict=True))

    def lines(self) -> Iterator[str]:
        """Yield a title and two tables, in Markdown."""
        num_rounds = max(map(len, self.samples.values()))
        times = "one round" if num_rounds == 1 else f"{num_rounds} rounds"
        yield f"### {self.kind}: {KINDS[self.kind]}; {self.what}; {times}\n"
        if COMPILED in self.samples:
            yield "| CPU ms per image | compiled | numpy | limit | ratio to pycolmap's load | spread | numpy | spread |"
            yield "|---|---:|---:|---:|---:|---:|---:|---:|"
            for name, samples in (("load", "pycolmap"), ("load, `update_point_3d_errors`", "pycolmap with errors")):
                seconds = [sample.parts["load"] for sample in self.samples[samples]]
                yield self._row(f"pycolmap: {name}", seconds)
            for name in STAGES:
                if name not in {"imports", JOINT}:
                    yield self._row(name, *self._of_stage(name), limit_s=self.limit_s[name])
            plain = [[own.plain for own in self.samples[path]] for path in (COMPILED, NUMPY)]
            limit_s = sum(seconds for name, seconds in self.limit_s.items() if name != JOINT)
            yield self._row("**all without the joint step**", *plain, limit_s=limit_s)
            yield f"{self._row(JOINT, *self._of_stage(JOINT), limit_s=self.limit_s[JOINT])}\n"
        yield from self._processes()

    def _of_stage(self, name: str) -> list[list[float]]:
        """CPU seconds of a stage, by path and round."""
        return [[sample.parts[name] for sample in self.samples[path]] for path in (COMPILED, NUMPY)]

    def _row(self, name: str, *by_path: Sequence[float], limit_s: float = 0.0) -> str:
        """One line of the first table; of pycolmap one column of seconds."""
        per_image = 1e3 / self.num_images
        times = [f"{statistics.median(seconds) * per_image:.2f}" for seconds in by_path]
        ratios = [[own / load for own, load in zip(seconds, self.loads, strict=True)] for seconds in by_path]
        spreads = [f"{statistics.median(found):.2f} | {min(found):.2f} .. {max(found):.2f}" for found in ratios]
        limit = f"{limit_s * per_image:.2f}" if limit_s else ""
        if len(by_path) == 1:
            times, spreads = [*times, ""], [*spreads, " | "]
        return f"| {name} | {' | '.join(times)} | {limit} | {' | '.join(spreads)} |"

    def _processes(self) -> Iterator[str]:
        """Yield the table of whole processes, imports included."""
        yield "| whole process | CPU, s | wall, s | peak memory, MB |\n|---|---:|---:|---:|"
        for name, samples in self.samples.items():
            cpu, wall, peak = (
                statistics.median(values)
                for values in zip(*((each.cpu, each.wall, each.peak / 1e6) for each in samples), strict=True)
            )
            yield f"| {name} | {cpu:.2f} | {wall:.2f} | {peak:.0f} |"
            if early := [each.early_peak for each in samples if each.early_peak]:
                yield f"| of it before the joint step | | | {statistics.median(early) / 1e6:.0f} |"
        yield ""
