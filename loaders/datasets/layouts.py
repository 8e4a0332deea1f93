"""How do folder names say which scene and which component a model is? One rule per layout of data sets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

Parts = tuple[str, ...]
ONLY_COMPONENT: Final = "0"


@dataclass(frozen=True, slots=True)
class Place:
    """What a model is called.

    num_below: how many of the names that lead to it lie below the scene's folder.
    layout: name of the rule; "" before `place_of` has found it.
    """

    scene: str
    component: str
    num_below: int
    layout: str = ""


@dataclass(frozen=True, slots=True)
class Layout:
    """One way to lay out a data set.

    place: asked with the names that lead to a model folder, says what the model is called, None where the names are
    not of this layout.    pattern: the same for people.
    """

    name: str
    pattern: str
    place: Callable[[Parts], Place | None]


def _megadepth(parts: Parts) -> Place | None:
    """MegaDepth_v1_SfM."""
    if len(parts) >= 4 and parts[-3:-1] == ("sparse", "manhattan"):
        return Place(parts[-4], parts[-1], 3)
    return None


def _megascenes(parts: Parts) -> Place | None:
    """MegaScenes: a scene is two folders of three digits each; only this data set calls a folder ``sparses``."""
    if len(parts) < 3 or parts[-2] not in {"sparses", "colmap"}:
        return None
    if len(parts) >= 4 and all(len(part) == 3 and part.isdigit() for part in parts[-4:-2]):
        return Place("/".join(parts[-4:-2]), parts[-1], 2)
    return Place(parts[-3], parts[-1], 2) if parts[-2] == "sparses" else None


def _phototourism(parts: Parts) -> Place | None:
    """Phototourism, Image Matching Challenge: one undistorted model per scene."""
    if len(parts) >= 3 and parts[-2:] == ("dense", "sparse"):
        return Place(parts[-3], ONLY_COMPONENT, 2)
    return None


_ETH3D: Final = frozenset(
    {
        *("dslr_calibration_jpg", "dslr_calibration_raw", "dslr_calibration_undistorted"),
        *("rig_calibration", "rig_calibration_undistorted"),
    }
)


def _eth3d(parts: Parts) -> Place | None:
    """ETH3D: one model per camera system and version of the images, all of one scene.

    Sources: eth3d.net/documentation (COLMAP's text files per version of the images); folders as COLMAP's rig tutorial
    and public loaders of the archives name them.
    """
    return Place(parts[-2], parts[-1], 1) if len(parts) >= 2 and parts[-1] in _ETH3D else None


def _scannetpp(parts: Parts) -> Place | None:
    """ScanNet++: data/<scene>/dslr/colmap, data/<scene>/iphone/colmap (its toolbox, common/scene_release.py)."""
    if len(parts) >= 3 and parts[-1] == "colmap" and parts[-2] in {"dslr", "iphone"}:
        return Place(parts[-3], parts[-2], 2)
    return None


def _imc(parts: Parts) -> Place | None:
    """Image Matching Challenge 2023 (train/<dataset>/<scene>/sfm) and 2024 (train/<scene>/sfm); 2021: phototourism.

    Public programs show ``train/<dataset>/<scene>/images`` and ``train/<scene>/images``, and a model in ``sfm`` of a
    copy of 2023's; none that could be found shows both in one path.
    """
    if len(parts) >= 3 and parts[-1] == "sfm" and parts[-3] == "train":
        return Place(parts[-2], ONLY_COMPONENT, 1)
    if len(parts) >= 4 and parts[-1] == "sfm" and parts[-4] == "train":
        return Place("/".join(parts[-3:-1]), ONLY_COMPONENT, 1)
    return None


def _visloc(parts: Parts) -> Place | None:
    """Ground truth of visual localization: Aachen's 3D-models, hloc's models of 7Scenes and Cambridge Landmarks.

    Source: hloc's pipelines (3D-models/aachen_v_1_1; 7scenes_sfm_triangulated/<scene>/triangulated;
    CambridgeLandmarks_Colmap_Retriangulated_1024px/<scene>/model_train).
    """
    if len(parts) >= 3 and parts[-2] == "3D-models":
        return Place(parts[-3], parts[-1], 2)
    if len(parts) >= 2 and parts[-1] in {"triangulated", "model_train"}:
        return Place(parts[-2], parts[-1], 1)
    return None


def _nerfstudio(parts: Parts) -> Place | None:
    """Nerfstudio, 3D Gaussian splatting; so lie mip-NeRF 360, Tanks and Temples for NeRF, and what GLOMAP writes."""
    if len(parts) >= 4 and parts[-3:-1] == ("colmap", "sparse"):
        return Place(parts[-4], parts[-1], 3)
    if len(parts) >= 3 and parts[-2:] == ("colmap", "sparse"):
        return Place(parts[-3], ONLY_COMPONENT, 2)
    if len(parts) >= 3 and parts[-2] == "sparse":
        return Place(parts[-3], parts[-1], 2)
    return None


def _d2net(parts: Parts) -> Place | None:
    """D2-Net's Undistorted_SfM: ``sparse`` and ``sparse-txt`` are one model, see `without_copies`."""
    is_undistorter_s = "dense" in parts[-3:-1]  # <scene>/dense/<k>/sparse
    if len(parts) >= 2 and parts[-1] in {"sparse", "sparse-txt"} and not is_undistorter_s:
        return Place(parts[-2], ONLY_COMPONENT, 1)
    return None


def _hloc(parts: Parts) -> Place | None:
    """hloc: the largest model lies in ``sfm*`` itself, the others stay in its ``models``; a scene may have several."""
    if len(parts) >= 2 and is_hloc(parts[-1]):
        return Place(parts[-2], parts[-1], 1)
    if len(parts) >= 4 and parts[-2] == "models" and is_hloc(parts[-3]):
        return Place(parts[-4], f"{parts[-3]}/{parts[-1]}", 3)
    return None


def is_hloc(name: str) -> bool:
    """Whether a folder is called as hloc's tools call their output."""
    return name.startswith("sfm")


def _colmap(parts: Parts) -> Place | None:
    """COLMAP's own tools, and any other folder: a scene of its own."""
    if len(parts) >= 4 and (parts[-3], parts[-1]) == ("dense", "sparse") and parts[-2].isdigit():
        return Place(parts[-4], parts[-2], 3)
    if len(parts) >= 3 and parts[-2] == "sparse":
        return Place(parts[-3], parts[-1], 2)
    if len(parts) >= 2 and parts[-1] == "sparse":
        return Place(parts[-2], ONLY_COMPONENT, 1)
    return Place(parts[-1], ONLY_COMPONENT, 0) if parts else Place("", ONLY_COMPONENT, 0)


LAYOUTS: Final[Mapping[str, Layout]] = {
    layout.name: layout
    for layout in (
        Layout("megadepth", "<scene>/sparse/manhattan/<component>", _megadepth),
        Layout("megascenes", "AAA/BBB/sparses/<component>, AAA/BBB/colmap/<component>", _megascenes),
        Layout("phototourism", "<scene>/dense/sparse", _phototourism),
        Layout("eth3d", "<scene>/dslr_calibration_*, <scene>/rig_calibration*", _eth3d),
        Layout("scannetpp", "<scene>/dslr/colmap, <scene>/iphone/colmap", _scannetpp),
        Layout("imc", "train/<scene>/sfm, train/<dataset>/<scene>/sfm", _imc),
        Layout("visloc", "<scene>/3D-models/<component>, <scene>/triangulated, <scene>/model_train", _visloc),
        Layout("nerfstudio", "<scene>/colmap/sparse/<component>, <scene>/sparse/<component>", _nerfstudio),
        Layout("d2net", "<scene>/sparse, <scene>/sparse-txt", _d2net),
        Layout("hloc", "<scene>/sfm*, <scene>/sfm*/models/<k>", _hloc),
        Layout("colmap", "<scene>/sparse/<component>, <scene>/sparse, or any folder", _colmap),
    )
}
"""Asked in this order; the first that knows the folder's names decides."""


def place_of(parts: Parts, layout: Layout | None = None) -> Place | None:
    """Return what the model in the folder with these path parts is called; None where ``layout`` does not know it."""
    asked = LAYOUTS.values() if layout is None else (layout,)
    places = ((each.name, each.place(parts)) for each in asked)
    found = next((replace(place, layout=name) for name, place in places if place), None)
    if layout is None and found and found.layout == "nerfstudio" and "colmap" not in parts[-3:-1]:
        return replace(found, layout="colmap")  # a plain sparse/<k> is what COLMAP itself writes; others read it too
    return found


def folders_to_search(parts: Parts, folders: list[str], *, is_model: bool, layout: Layout | None) -> list[str]:
    """Return which sub-folders of a folder may hold models: all but hidden ones, of a model none but hloc's."""
    if not is_model:
        return sorted(name for name in folders if not name.startswith("."))
    is_output = layout in {None, LAYOUTS["hloc"]} and bool(parts) and is_hloc(parts[-1])
    return ["models"] if is_output and "models" in folders else []


def without_copies(models: Mapping[Parts, Place], layout: Layout | None) -> dict[Parts, Place]:
    """Return the models without D2-Net's ``sparse-txt`` where ``sparse``, the same model in binary, is beside it."""
    if layout not in {None, LAYOUTS["d2net"]}:
        return dict(models)
    return {
        parts: place
        for parts, place in models.items()
        if not (parts and parts[-1] == "sparse-txt" and (*parts[:-1], "sparse") in models)
    }


def distinct(models: Mapping[Parts, Place]) -> dict[Parts, Place]:
    """Give models below one root names of their own.

    Where scene and component of several models are the same, the scene becomes the path of its folder below the root;
    where that does not tell them apart either (``sparse/0`` beside ``dense/0/sparse``), the component becomes the path
    below the scene's folder. ``models``: by the names that lead from the root to them.
    """
    named = dict(models)
    for rename in (_by_scene_path, _by_both_paths):
        groups: dict[tuple[str, str], list[Parts]] = {}
        for parts, place in named.items():
            groups.setdefault((place.scene, place.component), []).append(parts)
        for group in groups.values():
            if len(group) > 1:
                named |= {parts: rename(parts, named[parts]) for parts in group}
    return named


def _by_scene_path(parts: Parts, place: Place) -> Place:
    folder = parts[: max(0, len(parts) - place.num_below)]
    return replace(place, scene="/".join(folder) or place.scene)


def _by_both_paths(parts: Parts, place: Place) -> Place:
    folder = parts[max(0, len(parts) - place.num_below) :]
    return replace(place, component="/".join(folder) or place.component)
