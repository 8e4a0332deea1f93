"""Is the pose of every accepted image known well enough? Limits on standard deviations of ``run --covariance``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sfm_audit.reports.compare.comparison import ImageState
from sfm_audit.reports.compare.gate_policy import Limits
from sfm_audit.reports.compare.keys import Noted
from sfm_audit.reports.text.wording import counted

_ROUNDING: Final = 1e-9  # 0.3 - 0.2 is not above 0.1
_LIMITS: Final[dict[str, tuple[Callable[[ImageState], float | None], str]]] = {
    "max_sd_rotation_deg": (lambda image: image.sd_rotation_deg, "deg"),
    "max_sd_centre": (lambda image: image.sd_centre, "median depths"),
}


@dataclass(frozen=True, slots=True)
class PoseLimit:
    """What became of one limit.

    name: its key.    value: the largest standard deviation, None where none was measured.    allowed: the limit.
    message: in words.    images: those whose pose is known less well, and those of which nothing is known.
    """

    name: str
    value: float | None
    allowed: float
    message: str
    images: Noted

    @property
    def passed(self) -> bool:
        """Whether every accepted image is known that well."""
        return self.value is not None and not self.images


def pose_limits(limits: Limits, accepted: Sequence[ImageState]) -> Iterator[PoseLimit]:
    """Yield the limits on poses that a gate sets; of images that were not accepted nothing is asked."""
    for name, (sd_of, unit) in _LIMITS.items():
        allowed = getattr(limits, name)
        if allowed is None:
            continue
        words = f"at most {allowed:g} {unit} allowed"
        known = [sd for image in accepted if (sd := sd_of(image)) is not None]
        if not known:
            message = f"not measured; {words}; audit with sfm-audit run --covariance"
            yield PoseLimit(name, None, allowed, message, ())
            continue
        images: list[tuple[ImageState, str]] = []
        for image in accepted:
            sd = sd_of(image)
            if sd is None:
                images.append((image, "not known"))
            elif sd > allowed + _ROUNDING:
                images.append((image, f"{sd:.3g} {unit}"))
        noted = tuple(sorted((image.key, remark) for image, remark in images))
        message = f"{counted(len(noted), 'accepted image')} of {len(accepted)} known less well, the worst to "
        message += f"{max(known):.3g} {unit}; {words}"
        yield PoseLimit(name, max(known), allowed, message, noted)
