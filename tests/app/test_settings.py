"""Settings from preset, file and options, in this order, with strict checks."""

import dataclasses
from pathlib import Path

import pytest

from virest.app.settings import compose_settings, settings_model
from virest.camera.profile_file import read_profile
from virest.errors import SettingsError
from virest.restoration.settings import PRESETS, RestorationSettings

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def settings_file(folder: Path, text: str) -> Path:
    """Write a settings file."""
    path = folder / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_file_equals_its_preset(preset: str) -> None:
    """configs/<preset>.yaml is the preset written out, key by key."""
    assert compose_settings(CONFIGS / f"{preset}.yaml") == PRESETS[preset]
    keys = {line.split(":")[0] for line in (CONFIGS / f"{preset}.yaml").read_text().splitlines() if line[0].isalpha()}
    assert keys == {field.name for field in dataclasses.fields(RestorationSettings)} | {"virest_settings"}


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_file_in_configs_can_be_read(path: Path) -> None:
    """Each file is either a settings file or a camera profile."""
    if path.stem in PRESETS:
        compose_settings(path)
    else:
        read_profile(path)


def test_options_override_the_file_which_overrides_the_preset(tmp_path: Path) -> None:
    """Each layer changes only the keys it names."""
    path = settings_file(tmp_path, "preset: fast\ndeblur: wiener\niterations: 9\n")
    settings = compose_settings(path, deblur="inverse", shutter=None)
    assert settings == dataclasses.replace(PRESETS["fast"], deblur="inverse", iterations=9)


def test_the_preset_option_replaces_the_files_preset_and_keeps_its_keys(tmp_path: Path) -> None:
    """``--preset`` supplies the keys that the file does not set."""
    path = settings_file(tmp_path, "preset: fast\nstrength: 2.0\n")
    assert compose_settings(path, preset="best") == dataclasses.replace(PRESETS["best"], strength=2.0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("debblur: wiener\n", "did you mean 'deblur'"),
        ("iterations: 2.5\n", "iterations"),
        ("iterations: 0\n", "iterations"),
        ("joined_iterations: 1000000000\n", "joined_iterations"),
        ("neighbours: 99\n", "neighbours"),
        ("most_joined: 17\n", "most_joined"),
        ("strength: .nan\n", "strength"),
        ("strength: yes\n", "strength"),
        ("deblur: sharpest\n", "deblur"),
        ("virest_settings: 2\n", "virest_settings"),
        ("- a\n", "no keys"),
        ("a: &x 1\nb: *x\n", "aliases"),
        ("a: [1\n", "YAML"),
        ("", "no keys"),
    ],
)
def test_the_error_for_an_invalid_settings_file_names_file_and_key(tmp_path: Path, text: str, says: str) -> None:
    """One line names the file, the key and what is expected."""
    with pytest.raises(SettingsError, match=r"mine\.yaml") as caught:
        compose_settings(settings_file(tmp_path, text))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_settings_file_is_a_settings_error(tmp_path: Path) -> None:
    """It names the missing file."""
    with pytest.raises(SettingsError, match="no such file"):
        compose_settings(tmp_path / "none.yaml")


def test_every_setting_can_be_written_in_a_file() -> None:
    """The file's keys are the fields of the settings record."""
    assert settings_model().model_fields.keys() - {"virest_settings"} == {
        field.name for field in dataclasses.fields(RestorationSettings)
    }
