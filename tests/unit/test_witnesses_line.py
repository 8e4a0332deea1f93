"""The line about witnesses: nobody named, named and of no use, asked."""

from __future__ import annotations

from sfm_audit.reports.text.witnesses import NOBODY, witnesses_line


def test_what_was_named_and_fits_nothing_is_not_said_to_be_missing():
    assert witnesses_line({}, 1, 24, 0, {"disconnected"}) == NOBODY
    line = witnesses_line({}, 1, 24, 0, {"disconnected", "priors_not_used", "reference_not_used"})
    assert line.endswith("does not fit, as findings say (reference_not_used, priors_not_used).")
    assert "--reference" not in line


def test_witnesses_that_were_asked_are_counted():
    line = witnesses_line({"pairs": 1}, 2, 24, 20, {"priors_not_used"})
    assert line.endswith("pairs in 1 of 2 models; they can say nothing of 4 of 24 images.")
