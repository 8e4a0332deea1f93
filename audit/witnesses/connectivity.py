"""In how many parts does the model hang together, and by what? Columns and findings, no verdict (method.md 13)."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.audit.table.thresholds import MIN_SHARED_POINTS, WELL_SHARED_POINTS
from sfm_audit.audit.witnesses.covisibility import Covisibility, Cuts, cuts_of
from sfm_audit.audit.witnesses.evidence import ColumnValues, Evidence, WitnessReport
from sfm_audit.loaders.arrays import IntArray
from sfm_audit.loaders.model import Finding, FindingCode, SparseModel

_SHOWN: Final = 3


def ask_connectivity(evidence: Evidence) -> WitnessReport:
    """Return neighbours and strongest neighbour of each image, and where the model falls apart."""
    model = evidence.model
    seen = evidence.seen
    graph, well = (_with_frames(seen.at_least(num), model) for num in (MIN_SHARED_POINTS, WELL_SHARED_POINTS))
    cuts = cuts_of(graph)
    parts = graph.components()
    columns: dict[str, ColumnValues] = {
        "num_neighbours": seen.at_least(MIN_SHARED_POINTS).degree(),
        "num_shared_strongest": seen.strongest(),
        "covisible_part": parts,
        "is_articulation": cuts.articulation,
    }
    findings: tuple[Finding, ...] = ()
    if len(seen.num_shared):  # a model without points is another finding
        findings = (*_disconnected(model, parts), *_weakly(model, parts, well.components(), cuts))
    return WitnessReport(None, (), columns, findings)


def _with_frames(graph: Covisibility, model: SparseModel) -> Covisibility:
    """Join the images that one pose of their rig places: they hang together whatever they see."""
    frame_idx = model.images.frame_idx
    if frame_idx is None:
        return graph
    order = np.argsort(frame_idx, kind="stable")
    same = frame_idx[order][1:] == frame_idx[order][:-1]
    joined = np.sort(np.column_stack([order[:-1][same], order[1:][same]]), axis=1)
    edges = np.unique(np.vstack([np.column_stack([graph.first, graph.second]), joined]), axis=0)
    return Covisibility(edges[:, 0], edges[:, 1], np.ones(len(edges), np.int64), graph.num_images)


def _disconnected(model: SparseModel, parts: IntArray) -> tuple[Finding, ...]:
    sizes = np.bincount(parts)
    if len(sizes) < 2:
        return ()
    text = (
        f"{len(sizes)} parts of {_sizes(sizes)} images that share fewer than {MIN_SHARED_POINTS} points with each "
        f"other: nothing holds {_named(model, np.flatnonzero(parts != 0))} where they are relative to the largest"
    )
    return (Finding(FindingCode.DISCONNECTED, len(sizes), text),)


def _weakly(model: SparseModel, parts: IntArray, well: IntArray, cuts: Cuts) -> tuple[Finding, ...]:
    """What holds together at 15 points and falls apart at 30, or with one image or pair less."""
    said = []
    num_more = int(well.max(initial=0)) - int(parts.max(initial=0))
    if num_more > 0:
        apart = np.flatnonzero(_lost(parts, well))
        said.append(f"{num_more} more parts at {WELL_SHARED_POINTS} shared points ({_named(model, apart)})")
    if len(cuts.bridges):
        names = [" - ".join(model.images.name[i] for i in pair) for pair in cuts.bridges[:_SHOWN].tolist()]
        said.append(f"{len(cuts.bridges)} pairs without which it falls apart ({_listed(names, len(cuts.bridges))})")
    articulation = np.flatnonzero(cuts.articulation)
    if len(articulation):
        said.append(f"{len(articulation)} images without which it falls apart ({_named(model, articulation)})")
    if not said:
        return ()
    return (Finding(FindingCode.WEAKLY_CONNECTED, num_more + len(cuts.bridges) + len(articulation), "; ".join(said)),)


def _lost(parts: IntArray, well: IntArray) -> np.ndarray:
    """Images that are not in the largest well connected part of the part that they are in."""
    out = np.ones(len(parts), dtype=bool)
    for part in np.unique(parts):
        inside = parts == part
        out[inside & (well == np.bincount(well[inside]).argmax())] = False
    return out


def _sizes(sizes: IntArray) -> str:
    return _listed([str(size) for size in sizes[:5].tolist()], len(sizes), 5)


def _named(model: SparseModel, image_idx: IntArray) -> str:
    return _listed([model.images.name[i] for i in image_idx[:_SHOWN].tolist()], len(image_idx))


def _listed(shown: list[str], num: int, limit: int = _SHOWN) -> str:
    return ", ".join(shown) + (f" (+{num - limit})" if num > limit else "")
