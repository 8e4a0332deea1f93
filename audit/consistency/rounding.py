"""Are the stored poses rounded? Somebody printed them with a few decimals and read them again."""

from __future__ import annotations

from typing import Final

import numpy as np

from sfm_audit.loaders.arrays import BoolArray, FloatArray

MAX_DECIMALS: Final = 5
"""Six decimals of a quaternion turn a projection by thousandths of a pixel, and programs print as many."""
MIN_IMAGES: Final = 3


def rounded_decimals(quaternions: FloatArray, translations: FloatArray) -> int | None:
    """Return to how many decimals all poses are rounded; None where they are not, or say nothing.

    Parameters
    ----------
    quaternions : (I, 4) as stored, not normalised          translations : (I, 3) model units

    Returns
    -------
    int or None
        The smallest number of decimals, 0 to 5, that changes no number. None below three images whose quaternions have
        to be rounded to look so: quarter turns and half turns (components 0, +-0.5, +-1) have few decimals by nature.

    Notes
    -----
    A number counts as rounded when it is the double nearest to its rounded value, to a few units in the last place.
    Blind to what was rounded before it was transformed, and to numbers rounded in another basis than decimals.
    """
    values = np.concatenate([quaternions, translations], axis=1)
    telling = (2.0 * quaternions != np.rint(2.0 * quaternions)).any(axis=1)
    if int(np.count_nonzero(telling)) < MIN_IMAGES or not np.isfinite(values).all():
        return None
    return next((d for d in range(MAX_DECIMALS + 1) if _is_rounded(values, d).all()), None)


def _is_rounded(values: FloatArray, decimals: int) -> BoolArray:
    nearest = np.round(values, decimals)
    is_rounded: BoolArray = np.abs(values - nearest) <= 4.0 * np.spacing(np.abs(nearest))
    return is_rounded
