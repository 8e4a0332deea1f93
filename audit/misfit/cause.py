"""Which group is the cause, and which camera model would have fitted? (method.md section 5)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from typing import Final

import numpy as np

from sfm_audit.audit.cameras.functions import Term
from sfm_audit.audit.cameras.models import functions_of
from sfm_audit.audit.inliers.projected import project_image
from sfm_audit.audit.misfit.capabilities import extended_params, larger_models, undistorted_model
from sfm_audit.audit.misfit.design import ImageDesign
from sfm_audit.audit.misfit.fields import candidate_fields
from sfm_audit.audit.misfit.in_parts import AT_ONCE, PartedImage, image_tests_in_parts
from sfm_audit.audit.misfit.multiplicity import holm
from sfm_audit.audit.misfit.nuisance import nuisance_columns
from sfm_audit.audit.misfit.outcome import MisfitTest, MisfitTests
from sfm_audit.audit.misfit.score import prepare_image
from sfm_audit.audit.table.words import GROUPS, MisfitGroup, MisfitStatus
from sfm_audit.loaders.arrays import FloatArray, IntArray
from sfm_audit.loaders.camera_models import CameraModel
from sfm_audit.loaders.model import CameraRecord

Retest = Callable[[CameraRecord], MisfitTests]
"""The misfit tests of the same residuals if the camera had been fitted as this one, to first order."""

_NO_MODEL: Final = {
    MisfitGroup.ROLLING_SHUTTER: "none: rolling shutter",
    MisfitGroup.PRINCIPAL_POINT: "none: refine the principal point",
}
_LENS: Final = frozenset({MisfitGroup.RADIAL, MisfitGroup.TANGENTIAL, MisfitGroup.AFFINE})


def bic(test: MisfitTest, num_observations: int, sigma_px: float) -> float:
    """Return n px^2 / sigma^2 + r - r log(2n), by how much the group pays for its parameters; -inf if not tested.

    ``sigma_px``: the image's robust noise, ``sigma_constant_px``.
    """
    if test.status is not MisfitStatus.TESTED or test.rank is None:
        return -math.inf
    gain = num_observations * (test.px / sigma_px) ** 2 if sigma_px > 0 else math.inf if test.px > 0 else 0.0
    return gain + test.rank - test.rank * math.log(2 * num_observations)


def remaining_groups(
    tests: Mapping[MisfitGroup, MisfitTest], groups: Collection[MisfitGroup], *, alpha: float, tau_px: float
) -> tuple[MisfitGroup, ...]:
    """Return those of ``groups`` that are significant (Holm over all that ran) and larger than tau_px."""
    adjusted = holm(np.array([tests[group].p for group in GROUPS]))
    return tuple(
        group
        for group, p in zip(GROUPS, adjusted, strict=True)
        if group in groups and p < alpha and tests[group].px > tau_px
    )


def advised_camera_model(
    camera: CameraRecord,
    cause: MisfitGroup | None,
    material: Collection[MisfitGroup],
    *,
    retest: Retest | None = None,
    distortion_identified: bool = True,
    alpha: float = 0.05,
    tau_px: float = 0.2,
) -> str | None:
    """Return the smallest COLMAP model that holds what was found, "none: ..." where none does, None without advice.

    Parameters
    ----------
    cause : from `named_cause`; None where nothing is wrong
    material : groups that are significant and larger than tau_px, the cause among them
    retest : tries a model on the data; without it the advice rests on the table of what models hold
    distortion_identified : False when no distortion parameter differs from 0 by twice its standard deviation; then,
        and only if nothing is wrong, the advice is the model without distortion

    Notes
    -----
    With ``retest`` the advice is the smallest larger model of the family after whose refit, to first order, none of the
    material groups is left; echoes of the cause in other groups then cost no parameters, and a pinhole camera that only
    lacks k1 gets SIMPLE_RADIAL although radial starts at r^4. Where no model passes although the cause is a lens (too
    large for one linear step, or not alone), and without ``retest``, it is the smallest that has the terms: radial the
    next power of r from r^4 on, affine fx != fy, tangential p1 and p2. No model holds skew, or any smooth field.
    """
    if cause is None:
        simpler = None if distortion_identified else undistorted_model(camera.model)
        return simpler.name if simpler else None
    found = {cause, *material}
    larger = larger_models(camera.model)
    advised = None
    if cause is not MisfitGroup.ROLLING_SHUTTER and not (cause is MisfitGroup.PRINCIPAL_POINT and not found & _LENS):
        advised = _first_that_passes(camera, larger, found, retest, alpha=alpha, tau_px=tau_px)
        if advised is None and (retest is None or cause in _LENS):
            advised = _smallest_with(camera.model, larger, cause, found)
    return _NO_MODEL.get(cause, f"none: {cause}") if advised is None else advised.name


def extended_camera(camera: CameraRecord, model: CameraModel) -> CameraRecord | None:
    """Return the same camera as one of a larger model, new terms zero; None where that cannot express it."""
    params = extended_params(camera.model, camera.params, model)
    return None if params is None else dataclasses.replace(camera, model=model, params=params)


def image_retest(xyz_cam: FloatArray, residuals_px: FloatArray) -> Retest:
    """Return the retest of one image, given its points (n, 3) in the camera frame and residuals (2, n).

    The larger camera's own parameters join the nuisances at the present estimate: what they explain is what a refit of
    this image would remove, to first order, with the 3D points held. Good while the misfit is a matter of pixels.
    """

    def retest(camera: CameraRecord) -> MisfitTests:
        if len(xyz_cam) > AT_ONCE:
            return _test_in_parts(camera, xyz_cam, residuals_px)
        return prepare_image(camera, xyz_cam).test(residuals_px)

    return retest


def _test_in_parts(camera: CameraRecord, xyz_cam: FloatArray, residuals_px: FloatArray) -> MisfitTests:
    track = np.arange(len(xyz_cam))

    def nuisance(chosen: IntArray) -> FloatArray:
        return nuisance_columns(camera.model, project_image(camera, xyz_cam[chosen]))

    def part(chosen: IntArray) -> ImageDesign:
        projected = project_image(camera, xyz_cam[chosen])
        columns, fields = nuisance_columns(camera.model, projected), candidate_fields(camera, projected)
        return ImageDesign(columns, columns[:0], fields, residuals_px[:, chosen], track[chosen])

    return image_tests_in_parts(PartedImage(track, nuisance, part), track.size)


def _first_that_passes(
    camera: CameraRecord,
    larger: Collection[CameraModel],
    found: Collection[MisfitGroup],
    retest: Retest | None,
    *,
    alpha: float,
    tau_px: float,
) -> CameraModel | None:
    """The first of ``larger`` that leaves none of the groups found; None without retest, or where all leave some."""
    for candidate in larger if retest is not None else ():
        extended = extended_camera(camera, candidate)
        if extended is not None and retest is not None:
            left = remaining_groups(retest(extended), found, alpha=alpha, tau_px=tau_px)
            if not left:
                return candidate
    return None


def _smallest_with(
    model: CameraModel, larger: Collection[CameraModel], cause: MisfitGroup, found: Collection[MisfitGroup]
) -> CameraModel | None:
    """The first of ``larger`` with the terms that the model lacks for the groups found; None for skew, and if none."""
    terms = {term for group in found if (term := _missing_term(model, group)) is not None}
    if not terms or (cause in _LENS and _missing_term(model, cause) is None):
        return None
    return next((candidate for candidate in larger if functions_of(candidate).terms >= terms), None)


def _missing_term(model: CameraModel, group: MisfitGroup) -> Term | None:
    """The term that a model lacks for a group; None where it has it or no model does (skew)."""
    wanted: tuple[Term, ...] = ()
    match group:
        case MisfitGroup.RADIAL:
            wanted = (Term.RADIAL_4, Term.RADIAL_6, Term.RADIAL_8)
        case MisfitGroup.TANGENTIAL:
            wanted = (Term.TANGENTIAL,)
        case MisfitGroup.AFFINE:
            wanted = (Term.ASPECT,)
        case _:
            pass
    return next((term for term in wanted if term not in functions_of(model).terms), None)
