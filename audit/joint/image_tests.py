"""The tests of all groups of some images, and what admitting a group would do to an image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sfm_audit.audit.joint.candidates import CandidateScores
from sfm_audit.audit.joint.group_test import GroupSums, GroupTest, answers, group_root, test_groups
from sfm_audit.audit.joint.image_scores import GroupSumsOfImage
from sfm_audit.audit.joint.system import JointSystem
from sfm_audit.audit.joint.worth import Worth, worth_of, worths_of
from sfm_audit.audit.misfit.fields import GROUP_COLUMNS
from sfm_audit.audit.table.words import MisfitGroup

ImageTests = tuple[dict[MisfitGroup, GroupTest], dict[MisfitGroup, Worth]]


def tests_of_scores(system: JointSystem, scores: Mapping[int, CandidateScores], alpha: float) -> dict[int, ImageTests]:
    """Return by image the tests of all groups, and the worth of those with p < alpha.

    Parameters
    ----------
    scores : by image, of all candidate fields
    """
    if not scores:
        return {}
    images, known = list(scores), list(scores.values())
    sigma_px, rms_px = system.observations.sigma_px[images], system.observations.rms_px[images]
    by_group = {group: test_groups(known, own, sigma_px, rms_px) for group, own in GROUP_COLUMNS.items()}
    found: dict[int, ImageTests] = {}
    for k, image in enumerate(images):
        tests = {group: told[k] for group, told in by_group.items()}
        asked = {group: own for group, own in GROUP_COLUMNS.items() if tests[group].p < alpha}
        depth = system.median_depth(image) if asked else math.nan
        worth = {
            group: worth_of(system, image, known[k], own, group_root(known[k], own), depth=depth)
            for group, own in asked.items()
        }
        found[image] = tests, worth
    return found


def tests_of_sums(system: JointSystem, summed: Sequence[GroupSumsOfImage], alpha: float) -> dict[int, ImageTests]:
    """Return the same of images of one call of the kernel."""
    if not summed:
        return {}
    batch, places = summed[0].batch, [each.place for each in summed]
    images, numbers = batch.images[places], batch.numbers
    groups, num = list(GROUP_COLUMNS), len(GROUP_COLUMNS)
    statistic, gain, rank = numbers.statistic[places], numbers.gain[places], numbers.rank[places]
    sums = GroupSums(statistic.ravel(), gain.ravel(), rank.ravel(), np.ones(rank.size, dtype=bool))
    observations = system.observations
    of_images = batch.num_tracks, batch.num_observations
    scale = observations.sigma_px[images], observations.rms_px[images]
    told = answers(sums, *(np.repeat(each, num) for each in (*(each[places] for each in of_images), *scale)))
    found: dict[int, ImageTests] = {
        image: (dict(zip(groups, told[num * k : num * (k + 1)], strict=True)), {})
        for k, image in enumerate(images.tolist())
    }
    asked = np.array([k for k, test in enumerate(told) if test.p < alpha], dtype=np.int64)
    image, group = images[asked // num], asked % num
    distinct, place = np.unique(image, return_inverse=True)
    depth = system.median_depths(distinct)[place]
    change = numbers.change[places].reshape(len(told), -1)[asked]
    worths = worths_of(system, image, change, depth)
    for i, k, worth in zip(image.tolist(), group.tolist(), worths, strict=True):
        found[i][1][groups[k]] = worth
    return found
