"""Why was this image judged so? Its reasons in plain words with numbers, and its whole story as text."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from sfm_audit.audit.table.concerns import findings_about
from sfm_audit.audit.table.words import (
    MEMBER_QUESTIONS,
    MISFIT_CODES,
    Member,
    MisfitGroup,
    ReasonCode,
    Verdict,
    is_remark,
)
from sfm_audit.loaders.arrays import FloatArray
from sfm_audit.loaders.camera_models import BY_NAME
from sfm_audit.reports.text.reasons import reasons_of
from sfm_audit.reports.text.witnesses import testimony_lines
from sfm_audit.reports.text.wording import counted, number, paragraph, plain, probability, px

LIMITS: Final = (
    "KS judges the noise, not the camera: a correct camera with odd noise can be rejected, and a wrong lens can pass.",
    (
        "An accepted image agrees with its own reconstruction. That cannot see symmetric mis-registration, a wrong "
        "global scale, or drift. Another reconstruction of the same photos (check --baseline) sees folds and drift; "
        "docs/witnesses.md says who sees what, and how often."
    ),
    (
        "A pose that was adjusted together with its error is at its optimum, and a misfit below the effect that "
        "matters (--min-effect) is left alone."
    ),
    (
        "Standard deviations and expected errors are small still: on photos with known cameras real errors are up to "
        "5 times the standard deviation (docs/realtruth.md)."
    ),
    "Undetermined is no pass: the image does not say enough about itself.",
)
"""What a verdict does not prove."""

_WORDS: Final = {
    "ks_rejected": "the noise is not what the noise model says ({detail}){tails}",
    "too_few_observations": "too few observations for a verdict: {detail}",
    "non_finite_pose": "the stored pose is no pose: {detail} are not finite",
    "non_finite_camera": "the stored camera is no camera: {detail} are not finite",
    "missing_camera": "the model does not hold its camera ({detail})",
    "extreme_values": "the stored camera or pose holds numbers that nothing can be calculated with ({detail})",
    "exact_projections": "its 2D points are projections of the 3D points, not measurements ({detail})",
    "noise_not_fitted": "the noise could not be estimated ({detail})",
    "non_finite_derivatives": "the projection has no finite derivatives ({detail})",
    "misfit_radial": "{lens}: {size}",
    "misfit_tangential": "the lens is decentred as {model} does not say: {size}",
    "misfit_affine": "the pixels are not as square as {model} has them, or the axes are skewed: {size}",
    "misfit_principal_point": "the optical axis is not where the camera has its principal point: {size}",
    "misfit_rolling_shutter": "the camera moved while its rows were read out, one after the other: {size}",
    "misfit_smooth": "something bends the image smoothly that is none of the named lens errors: {size}",
    "shared_camera": "not this image alone: its camera as a whole is at fault ({detail})",
    "misfit_not_tested": "some kinds of misfit could not be tested: {detail}",
    "pose_not_optimal": "the pose is not where its own points want it ({detail} px RMS that moving it would remove)",
    "focal_out_of_range": "no camera has such a focal length: {detail}",
    "distortion_folds": "the distortion folds the image over itself ({detail})",
    "principal_point_outside": "the principal point lies outside the image ({detail})",
    "focal_not_identified": "its points do not fix the focal length ({detail})",
    "k1_not_identified": "its points do not fix the distortion ({detail})",
    "low_coverage": "its points see too little of the image ({detail})",
    "few_occupied_cells": "its points lie in too few parts of the image ({detail} cells)",
    "fronto_parallel": "its points lie in a plane that is nearly parallel to the image ({detail})",
    "degenerate_input": "its points determine no camera ({detail})",
    "inconsistent": "camera, pose, points and 2D points do not belong together: {detail}",
    "points_behind": "nothing of it lies before the camera: {detail}",
    "camera_not_optimal": "a parameter of its camera is not where adjusting everything would put it: {detail}",
    "camera_not_tested": "its camera could not be asked in the joint system ({detail})",
    "misfit_without_worth": "a misfit that would change pose and focal length by next to nothing: {detail}",
    "noise_differs": "the noise is visibly another one than the noise model says ({detail}){tails}",
    "pairs_disagree": "its verified matches with neighbours contradict the cameras: {detail}",
    "fold_disagrees": "images that should see the same points see two different sets of them: {detail}",
    "reference_disagrees": "the pose is not where the reference has it: {detail}",
    "priors_disagree": "the centre is not where its prior has it: {detail}",
    "pixel_convention": "half a pixel between 2D points and cameras explains it: {detail}",
}
REASON_CODES: Final = frozenset(_WORDS)

_CENTRE: Final = 0.35  # of the half diagonal
_CORNER: Final = 0.75
_CLEARLY: Final = 1.35  # times the RMS over the whole image


def plain_reason(reason: Mapping[str, Any], row: Mapping[str, Any], *, where: str | None = None) -> str:
    """Say one reason in plain words, with the numbers that triggered it.

    Parameters
    ----------
    reason : of `reasons_of`
    row : the image's row of ``RUN/images``
    where : where in the image a misfit is strongest, from `strongest_where`
    """
    code, detail = reason["code"], reason["text"]
    words = _WORDS.get(code)
    if words is None:
        return plain(f"{code}: {detail}")
    model = row["camera_model"] or "the camera"
    said = words.format(
        detail=_pose_words(reason) if code == ReasonCode.POSE_NOT_OPTIMAL else detail,
        model=model,
        size=_size_words(reason, row, where),
        lens=_lens_words(str(model)),
        tails=_tails(row),
    )
    advice = row["advised_camera_model"]
    if code in MISFIT_CODES.values() and advice:
        said += f"; {_advice_words(str(advice))}"
    return plain(said)


def plain_reasons(row: Mapping[str, Any]) -> list[str]:
    """Say why the image of a row of ``RUN/images`` is judged so, remarks last and named as such."""
    said = [(is_remark(reason["code"], row), plain_reason(reason, row)) for reason in reasons_of(dict(row))]
    return [text for remark, text in said if not remark] + [f"Remark: {text}" for remark, text in said if remark]


def strongest_where(xy_px: FloatArray, field_px: FloatArray, size_px: tuple[float, float]) -> str | None:
    """Say where a field (n, 2) at points (n, 2) is strongest; None where it is much the same everywhere."""
    if not len(xy_px):
        return None
    share = (xy_px - np.array(size_px) / 2.0) / (np.array(size_px) / 2.0)  # -1 .. 1
    radius = np.hypot(*share.T) / math.sqrt(2.0)
    sq = (field_px**2).sum(axis=1)
    regions = {
        "in the corners": radius > _CORNER,
        "in the centre": radius < _CENTRE,
        "at the left and right edges": (np.abs(share[:, 0]) > 0.75) & (np.abs(share[:, 1]) < 0.6),
        "at the top and bottom edges": (np.abs(share[:, 1]) > 0.75) & (np.abs(share[:, 0]) < 0.6),
    }
    ratio = {name: float(sq[inside].mean() / sq.mean()) for name, inside in regions.items() if inside.sum() >= 5}
    best = max(ratio, key=lambda name: ratio[name], default=None)
    return f"strongest {best}" if best and ratio[best] > _CLEARLY**2 else None


@dataclass(frozen=True, slots=True, eq=False)
class Story:
    """What is told about one image.

    row: of ``RUN/images``.    where: of `strongest_where`.    pictures: file name -> caption.
    decided_again: the settings after the run, in words; None for its own.    model: the row of ``RUN/models`` of its
    model, whose findings are told; None where nobody has it.
    """

    row: Mapping[str, Any]
    config: Mapping[str, Any]
    location: str
    where: str | None
    pictures: Mapping[str, str]
    decided_again: str | None = None
    model: Mapping[str, Any] | None = None


def render_story(story: Story, width: int = 100) -> str:
    """Return the whole story of one image as text."""
    row = story.row
    reasons = reasons_of(dict(row))
    decide = [reason for reason in reasons if not is_remark(reason["code"], row)]
    remarks = [reason for reason in reasons if is_remark(reason["code"], row)]
    parts = [
        _heading(story, width),
        _bullets("Why", decide, story, width) if decide else "Why\n  nothing speaks against it",
        _bullets("Remarks (decide nothing)", remarks, story, width) if remarks else "",
        _finding_lines(row, story.model, width) if story.model else "",
        _verdict_lines(row),
        testimony_lines(row, width),
        _camera_lines(row, width),
        _number_lines("What it was measured with", _observation_facts(row)),
        _number_lines("Noise", _noise_facts(row)),
        _misfit_lines(row, story.config, story.where),
        _number_lines("Pose and parameters", _parameter_facts(row, story.config)),
        _picture_lines(story.pictures, width),
        "\n".join(["What a verdict does not prove", *(paragraph(f"- {text}", width, "  ") for text in LIMITS)]),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _size_words(reason: Mapping[str, Any], row: Mapping[str, Any], where: str | None) -> str:
    """Say how large a misfit is; ``also``: the other groups that matter, as the text of the reason has them."""
    if reason["value"] is None:
        return str(reason["text"])
    _, _, also = str(reason["text"]).partition("(also ")
    said = f"; also {also.rstrip(')').replace('_', ' ')}" if also else ""
    q = f" (q = {row['misfit_q']:.2g}{said})" if row["misfit_q"] is not None else ""
    return f"{reason['value']:.2f} px RMS" + (f", {where}" if where else "") + q


def _pose_words(reason: Mapping[str, Any]) -> str:
    if reason["value"] is None or reason["limit"] is None:
        return str(reason["text"])
    return f"{reason['value']:.3g} > {reason['limit']:g}"


def _lens_words(model: str) -> str:
    """Say what a misfit along the radius means for this camera model."""
    camera = BY_NAME.get(model)
    names = [name for name in camera.param_names if re.fullmatch(r"k[0-9]*|omega", name)] if camera else []
    names = ["k1" if name == "k" else name for name in names]
    if not names:
        return f"the lens bends, and {model} has no word for it"
    return (
        f"the lens bends more than {' and '.join([', '.join(names[:-1]), names[-1]] if names[1:] else names)} can say"
    )


def _tails(row: Mapping[str, Any]) -> str:
    kurtosis, ratio = row["kurtosis_excess"], row["scale_ratio"]
    said = []
    if kurtosis is not None and abs(kurtosis) > 0.3:
        said.append(f"{'heavier' if kurtosis > 0 else 'lighter'} tails than normal (excess kurtosis {kurtosis:.2g})")
    if ratio is not None and abs(math.log(max(ratio, 1e-9))) > 0.3:
        said.append(f"{ratio:.2g} times the variance that the rest of its tracks predicts")
    return "; " + ", ".join(said) if said else ""


def _advice_words(advice: str) -> str:
    if advice.startswith("none"):
        what = advice.partition(":")[2].strip()
        named = {
            "rolling shutter": "no camera model of COLMAP holds a rolling shutter",
            "refine the principal point": "refine the principal point",
        }
        return named.get(what, "no larger camera model of COLMAP would hold it")
    return f"{advice} would hold it"


def _heading(story: Story, width: int) -> str:
    row = story.row
    name, place = plain(row["image_name"]), plain(story.location)
    policy = story.config.get("policy")
    lines = [f"{name} (id {row['image_id']}): {str(row['verdict']).upper()} under the policy {policy}", f"in {place}"]
    if story.decided_again:
        lines.append(f"decided again after the run: {story.decided_again}")
    return "\n".join(paragraph(line, width, "  ") for line in lines)


def _bullets(title: str, reasons: Sequence[Mapping[str, Any]], story: Story, width: int) -> str:
    lines = [paragraph(f"- {plain_reason(r, story.row, where=story.where)}", width, "  ") for r in reasons]
    return "\n".join([title, *lines])


def _finding_lines(row: Mapping[str, Any], model: Mapping[str, Any], width: int) -> str:
    """Say which findings of the model concern the image, and how many do not."""
    findings = model["findings"] or []
    about = findings_about(row, findings, model["num_images"])
    others = len(findings) - len(about)
    lines = [paragraph(f"- {plain(f['code'])}: {plain(f['text'])}", width, "  ") for f in about]
    if others:
        more = "more finding" if about else "finding"
        lines.append(paragraph(f"- {counted(others, more)} about other images, or points and files", width))
    if not lines:
        return ""
    return "\n".join(["Findings about its model (sfm-audit explain-code CODE says what to do)", *lines])


def _verdict_lines(row: Mapping[str, Any]) -> str:
    asked = {words: row[member] for member, words in MEMBER_QUESTIONS.items() if row[member] is not None}
    return "\n".join(["The questions, one by one", *(f"  {words:<54}{verdict}" for words, verdict in asked.items())])


def _camera_lines(row: Mapping[str, Any], width: int) -> str:
    camera = BY_NAME.get(row["camera_model"] or "")
    if camera is None or row["params"] is None:
        return "Camera\n  none that the model holds"
    pairs = zip(camera.param_names, row["params"], strict=True)
    params = ", ".join(f"{name} {value:.6g}" for name, value in pairs)
    size = f"{row['width']} x {row['height']} px"
    text = f"  camera {row['camera_id']}: {camera.name}, {size}, {params}"
    advice = row["advised_camera_model"]
    if advice and row[Member.MISFIT] != Verdict.REJECTED:
        text += f". {advice} would say as much: the distortion is not identified"
    return "\n".join(["Camera", paragraph(text, width, "    ")])


def _number_lines(title: str, facts: Sequence[tuple[str, str]]) -> str:
    return "\n".join([title, *(f"  {name:<62}{value}" for name, value in facts)])


def _observation_facts(row: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        ("2D points, of them inliers", f"{row['num_points2d']}, {row['num_inliers']}"),
        (
            "lost: behind the camera, not finite, without 3D point",
            f"{row['num_behind']}, {row['num_nonfinite']}, {row['num_dangling']}",
        ),
        (
            "verified by their own tracks, mean track length",
            f"{row['num_standardised']}, {number(row['mean_track_length'])}",
        ),
        ("share of the image inside their hull, occupied cells", f"{number(row['coverage'])}, {row['occupied_cells']}"),
    ]


def _noise_facts(row: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [
        (
            "reprojection error RMS, median, 95 %, largest, px",
            _series(row, px, "rms_px", "median_px", "p95_px", "max_px"),
        ),
        ("robust noise per axis, px", px(row["sigma_constant_px"])),
        (f"predicted noise per axis ({row['noise_model']}), px", px(row["sigma_predicted_px"])),
        ("observed / predicted variance", number(row["scale_ratio"])),
        (f"KS distance and p, {row['noise_model']} noise", f"{number(row['ks_stat'], 3)}, {probability(row['ks_p'])}"),
        (
            "KS distance and p, constant noise",
            f"{number(row['ks_constant_stat'], 3)}, {probability(row['ks_constant_p'])}",
        ),
        (
            f"excess kurtosis, {row['noise_model']} and constant noise",
            f"{number(row['kurtosis_excess'])}, {number(row['kurtosis_constant'])}",
        ),
    ]


def _parameter_facts(row: Mapping[str, Any], config: Mapping[str, Any]) -> list[tuple[str, str]]:
    relative = row["sd_focal_rel"]
    return [
        (
            f"residual that moving the pose would remove (at most {config.get('pose_offset_threshold_px')}), px",
            px(row["pose_offset_px"]),
        ),
        ("focal length / longer side", number(row["focal_over_size"])),
        ("sd of the focal length", "-" if relative is None else f"{relative:.2%}"),
        ("what freeing the camera's own parameters would gain, px", px(row.get("own_step_px"))),
        ("expected error of one measurement, px", px(row["expected_error_px"])),
        *_pose_facts(row),
    ]


def _pose_facts(row: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How well the pose is known, where somebody asked (``run --covariance``)."""
    if row.get("sd_rotation_deg") is None:
        return []
    facts = [
        ("sd of the rotation, of the centre in median depths", (row["sd_rotation_deg"], row["sd_centre"])),
        ("the same against its strongest neighbour", (row["sd_rotation_rel_deg"], row["sd_centre_rel"])),
    ]
    return [(name, "-" if turn is None else f"{turn:.2g} deg, {centre:.2g}") for name, (turn, centre) in facts]


def _series(row: Mapping[str, Any], show: Any, *names: str) -> str:
    return ", ".join(show(row[name]) for name in names)


def _misfit_lines(row: Mapping[str, Any], config: Mapping[str, Any], where: str | None) -> str:
    tau = config.get("min_effect")
    lines = [f"Misfit: what of the residuals is systematic, and nothing else could take up (matters above {tau})"]
    for group in MisfitGroup:
        joint, stands = row.get(f"misfit_{group}_px_joint"), row[f"misfit_{group}_px"]
        if joint is not None:
            said = f"{px(joint)} px RMS, q = {probability(row[f'misfit_{group}_q_joint'])}"
        else:
            said = "the camera model has it already" if row[f"misfit_{group}_rank"] == 0 else "not tested"
        alone = f"   (the image alone: {px(stands)} px)" if stands is not None else ""
        lines.append(f"  {group.replace('_', ' '):<20}{said}{alone}")
    if row["misfit_group"]:
        cause = f"  named cause: {row['misfit_group'].replace('_', ' ')}, {px(row['misfit_px'])} px RMS"
        lines.append(cause + (f", {where}" if where else "") + _worth_words(row))
    return "\n".join(lines)


def _worth_words(row: Mapping[str, Any]) -> str:
    """Say what admitting the misfit would change."""
    turn, focal = row.get("misfit_worth_deg"), row.get("misfit_worth_focal_rel")
    if turn is None:
        return ""
    said = f"{turn:.2g} degrees"
    return f"; worth {said}" if focal is None else f"; worth {said} and {abs(focal):.2g} of the focal length"


def _picture_lines(pictures: Mapping[str, str], width: int) -> str:
    if not pictures:
        return ""
    return "\n".join(["Pictures", *(paragraph(f"  {name}: {text}", width, "    ") for name, text in pictures.items())])
