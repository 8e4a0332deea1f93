"""What does a gate file ask for? Absolute limits, and bands against a baseline; unknown keys are refused.

docs/nightly.md explains every key to users.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from sfm_audit.reports.compare.keys import Scope

_Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
_Above0 = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=0)]
_Rise = Annotated[float, Field(ge=0)]  # inf: not checked


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Limits(_Section):
    """Absolute limits of one scope; what is left out is not checked."""

    min_images: _Count | None = None
    min_share_accepted: _Share | None = None
    max_share_rejected: _Share | None = None
    max_share_undetermined: _Share | None = None
    max_share_rejected_by_reason: Mapping[str, _Share] = Field(default_factory=dict)
    max_share_by_reason: Mapping[str, _Share] = Field(default_factory=dict)
    max_median_sigma_px: _Above0 | None = None
    max_noise_s0_px: _Above0 | None = None
    max_recomputed_error_px: _Above0 | None = None
    max_sd_rotation_deg: _Above0 | None = None
    max_sd_centre: _Above0 | None = None
    max_lost_images: _Count | None = None


class Band(_Section):
    """How far a run may be from its baseline; the defaults hold where a gate file says nothing.

    Shares are of the baseline's images (lost_images), of the images in both runs (newly_rejected,
    camera_model_changed), or of the images of each run (share_*: by how much the share may fall or rise).
    median_sigma, noise_s0 and recomputed_error: relative rise, 0.15 for 15 %. systematic_px: by how much the systematic
    error of any image may grow. fragments: groups of images that moved together; moved_images: share of the images in
    both runs; pose_centre and bending: median depths; pose_rotation_deg: degrees. inf: not checked.
    """

    lost_scenes: _Rise = 0
    lost_models: _Rise = 0
    lost_images: _Rise = 0.02
    camera_model_changed: _Rise = 0
    newly_rejected: _Rise = 0.05
    share_accepted: _Rise = 0.10
    share_rejected: _Rise = 0.05
    share_rejected_by_reason: _Rise = 0.05
    median_sigma: _Rise = 0.15
    noise_s0: _Rise = 0.15
    recomputed_error: _Rise = 0.15
    systematic_px: _Rise = 0.25
    fragments: _Rise = 0
    moved_images: _Rise = 0.05
    pose_centre: _Rise = 0.02
    pose_rotation_deg: _Rise = 0.5
    bending: _Rise = 0.1


BAND_KEYS: Final = tuple(Band.model_fields)


class PartPolicy(_Section):
    """Limits and bands of the datasets or scenes whose name matches a glob."""

    match: str
    limits: Limits = Limits()
    band: Band = Band()

    def matches(self, scope: Scope) -> bool:
        """Whether the glob matches a dataset's name; a scene's, with or without its dataset."""
        names = [scope.name] if scope.scene is None else [scope.scene, scope.name]
        return any(fnmatchcase(name, self.match) for name in names)


class GatePolicy(_Section):
    """A gate file. limits: of the whole run; band: of every scope that a section does not say otherwise about."""

    limits: Limits = Limits()
    band: Band = Band()
    dataset: tuple[PartPolicy, ...] = Field(default=(), strict=False)
    scene: tuple[PartPolicy, ...] = Field(default=(), strict=False)

    def sections(self, kind: Literal["dataset", "scene"]) -> Sequence[PartPolicy]:
        """Return the sections for datasets or for scenes."""
        return self.dataset if kind == "dataset" else self.scene

    def limits_of(self, scope: Scope) -> Limits:
        """Return the limits of a scope; of several sections that match, later ones come before earlier ones."""
        if scope.kind == "run":
            return self.limits
        return Limits(**_said(section.limits for section in self._matching(scope)))

    def band_of(self, scope: Scope) -> Band:
        """Return the band of a scope: matching sections, later ones first, then the file's own, then the defaults."""
        return Band(**_said([self.band, *(section.band for section in self._matching(scope))]))

    @property
    def needs_baseline(self) -> str | None:
        """The first limit that means nothing without a baseline."""
        places = [("limits", self.limits)]
        for kind in ("dataset", "scene"):
            places += [(f"{kind} {section.match!r}: limits", section.limits) for section in getattr(self, kind)]
        return next(
            (f"{place}.max_lost_images" for place, limits in places if limits.max_lost_images is not None), None
        )

    @property
    def reason_codes(self) -> tuple[tuple[str, str], ...]:
        """All reason codes that the file names, each with its key."""
        limits = [self.limits, *(section.limits for section in (*self.dataset, *self.scene))]
        keys = ("max_share_rejected_by_reason", "max_share_by_reason")
        return tuple(dict.fromkeys((key, code) for each in limits for key in keys for code in getattr(each, key)))

    def _matching(self, scope: Scope) -> list[PartPolicy]:
        if scope.kind == "run":
            return []
        sections = self.dataset if scope.scene is None else self.scene
        return [section for section in sections if section.matches(scope)]


def _said(sections: Any) -> dict[str, Any]:
    """What sections say, later ones over earlier ones; defaults are not said."""
    said: dict[str, Any] = {}
    for section in sections:
        for name in section.model_fields_set:
            value = getattr(section, name)
            said[name] = {**said.get(name, {}), **value} if isinstance(value, Mapping) else value
    return said
