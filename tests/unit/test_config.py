import pytest
from pydantic import ValidationError

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.settings import read_config
from sfm_audit.audit.config import AuditConfig


def write(tmp_path, text):
    file = tmp_path / "audit.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_every_setting_is_documented_and_has_a_default():
    assert AuditConfig() == AuditConfig.model_validate(AuditConfig().model_dump())
    for name, field in AuditConfig.model_fields.items():
        assert field.description, name


def test_a_config_does_not_change():
    with pytest.raises(ValidationError, match="frozen"):
        AuditConfig().alpha = 0.1


def test_defaults_then_file_then_command_line(tmp_path):
    file = write(tmp_path, 'noise = "constant"\nalpha = 0.01\npose_offset_threshold_px = 1\n')
    assert read_config(None, {"noise": None}) == AuditConfig()
    from_file = read_config(file, {"noise": None, "policy": None})
    assert (from_file.noise, from_file.alpha, from_file.pose_offset_threshold_px) == ("constant", 0.01, 1.0)
    assert read_config(file, {"noise": "track"}) == from_file.model_copy(update={"noise": "track"})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("alhpa = 0.1", "unknown setting alhpa, did you mean alpha?"),
        (
            "colour = 1",
            "unknown setting colour; expected one of noise, points, database, covariance, reference",
        ),
        ('alpha = "small"', "alpha: expected a valid number, found 'small'"),
        ("alpha = 1.5", "alpha: expected less than 1, found 1.5"),
        ("min_observations = 20.5", "min_observations: expected a valid integer, found 20.5"),
        ("min_observations = true", "min_observations: expected a valid integer, found True"),
        ('noise = "loud"', "noise: expected 'track', 'constant' or 'keypoint', found 'loud'"),
        ('points = "both"', "points: expected 'in-sample' or 'independent', found 'both'"),
        ('min_effect = "0.2"', "min_effect: expected a number with its unit, such as 0.2px or 0.5sigma, found '0.2'"),
        ("min_effect = 0.2", "min_effect: expected a number with its unit, such as 0.2px or 0.5sigma, found 0.2"),
        ('points = "independent"', "points = independent takes noise = constant, not track"),
        ("[audit]\nalpha = 0.1", "unknown setting audit"),
        ("alpha = ", "not a TOML file"),
    ],
)
def test_a_wrong_file_is_one_line_that_names_file_and_key(tmp_path, text, words):
    file = write(tmp_path, text)
    with pytest.raises(KnownError) as caught:
        read_config(file, {})
    assert caught.value.exit_code == ExitCode.USAGE
    assert str(caught.value).startswith(f"{file}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"min_effect": "nonsense"},
            "--min-effect: expected a number with its unit, such as 0.2px or 0.5sigma, found 'nonsense'",
        ),
        ({"noise": "loud"}, "--noise: expected 'track', 'constant' or 'keypoint', found 'loud'"),
        ({"points": "independent"}, "--points: points = independent takes noise = constant, not track"),
        (
            {"points": "independent", "noise": "keypoint"},
            "--points, --noise: points = independent takes noise = constant, not keypoint",
        ),
    ],
)
def test_wrong_options_are_one_line_that_names_the_option(options, message):
    with pytest.raises(KnownError) as caught:
        read_config(None, {"policy": None, **options})
    assert caught.value.exit_code == ExitCode.USAGE
    assert str(caught.value) == message


def test_the_command_line_may_complete_a_file_and_contradict_it(tmp_path):
    file = write(tmp_path, 'points = "independent"\n')
    assert read_config(file, {"noise": "constant"}).points == "independent"
    with pytest.raises(KnownError) as caught:
        read_config(file, {"noise": "track"})
    assert str(caught.value) == f"{file}, --noise: points = independent takes noise = constant, not track"


@pytest.mark.parametrize(
    ("text", "sigma_px", "tau_px"), [("0.2px", 0.5, 0.2), (".3px", 9.0, 0.3), ("0.5sigma", 0.1, 0.05)]
)
def test_min_effect_is_px_or_the_image_s_sigma(text, sigma_px, tau_px):
    assert AuditConfig(min_effect=text).tau_px(sigma_px) == pytest.approx(tau_px, rel=1e-12)


def test_a_missing_file_and_one_that_is_no_text_are_said_so(tmp_path):
    with pytest.raises(KnownError, match="cannot be read"):
        read_config(tmp_path / "none.toml", {})
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(KnownError, match="not a TOML file"):
        read_config(tmp_path / "binary.toml", {})
