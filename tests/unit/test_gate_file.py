from pathlib import Path

import pytest

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.gate_file import read_gate_file


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("limit = 1", "unknown key limit, did you mean limits?"),
        ("limits.min_share = 1", "unknown key limits.min_share, did you mean min_share_accepted?"),
        ("width = 1", "unknown key width; expected one of limits, band, dataset, scene"),
        ('[[scene]]\nmatch = "a"\n[[scene]]\nmatch = "b"\nlimits.x = 1', "unknown key scene[2].limits.x"),
        ("[[scene]]\nlimits.min_images = 1", "scene[1].match is missing"),
        ("limits.min_share_accepted = 1.5", "limits.min_share_accepted: expected less than or equal to 1, found 1.5"),
        ("limits.min_share_accepted = '90 %'", "limits.min_share_accepted: expected a valid number, found '90 %'"),
        ("limits.min_images = true", "limits.min_images: expected a valid integer, found True"),
        ("limits.max_median_sigma_px = 0", "limits.max_median_sigma_px"),
        ("limits.max_median_sigma_px = nan", "limits.max_median_sigma_px"),
        ("band.median_sigma = -0.1", "band.median_sigma: expected greater than or equal to 0, found -0.1"),
        ("band.median_sigma = nan", "band.median_sigma"),
        ("limits.max_share_rejected_by_reason = {ks = 0.1}", "unknown reason ks; docs/verdicts.md lists them"),
        ("limits.max_share_rejected_by_reason = {misfit_radail = 0.1}", "misfit_radail, did you mean misfit_radial?"),
        ("limits.max_share_by_reason = {priors_disagre = 0.1}", "unknown reason priors_disagre, did you mean priors_"),
        (
            "limits.max_share_rejected_by_reason = {priors_disagree = 0.1}",
            "max_share_rejected_by_reason: priors_disagree rejects no image, so no share is too large; use",
        ),
        ("limits.max_share_rejected_by_reason.ks_rejected = 2", "limits.max_share_rejected_by_reason.ks_rejected"),
        ("limits.max_lost_images = 0", "limits.max_lost_images needs --baseline RUN0"),
        ('[[scene]]\nmatch = "a"\nlimits.max_lost_images = 0', "scene 'a': limits.max_lost_images needs --baseline"),
        ("limits", "not a TOML file"),
    ],
)
def test_what_is_wrong_with_a_gate_file_is_one_line_that_names_file_and_key(tmp_path, text, words):
    file = tmp_path / "gate.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(KnownError) as raised:
        read_gate_file(file, has_baseline=False)
    assert raised.value.exit_code is ExitCode.USAGE
    assert str(raised.value).startswith(f"{file}: ")
    assert words in str(raised.value)


def test_a_gate_file_that_is_not_there(tmp_path):
    with pytest.raises(KnownError, match=r"gate.toml: cannot be read \(No such file"):
        read_gate_file(tmp_path / "gate.toml", has_baseline=True)


def test_the_documented_example_is_valid(tmp_path):
    page = (Path(__file__).parents[2] / "docs/nightly.md").read_text(encoding="utf-8")
    blocks = [part.split("```")[0] for part in page.split("```toml\n")[1:]]
    assert blocks
    for block in blocks:
        file = tmp_path / "gate.toml"
        file.write_text(block, encoding="utf-8")
        read_gate_file(file, has_baseline=True)
