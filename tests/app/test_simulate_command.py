"""``virest simulate`` and the use of its captures."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from virest.app import sample

Virest = Callable[..., "subprocess.CompletedProcess[str]"]
SMALL = ("--width", 160, "--height", 120, "--frames", 3)


def test_a_simulated_capture_can_be_inspected_and_processed(virest: Virest, tmp_path: Path) -> None:
    """``inspect`` and ``process`` accept what ``simulate`` wrote."""
    made = virest("simulate", "trip", *SMALL, "--effect", "time_offset=0.004", "--json", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    facts = json.loads(made.stdout)
    assert facts["effects"] == [{"name": "time_offset", "parameters": {"time_offset_s": 0.004}}]
    assert (tmp_path / "trip/truth/frames/000002.png").is_file()
    assert virest("inspect", "trip", cwd=tmp_path).returncode == 0
    done = virest("process", "trip", "--preset", "fast", "--jobs", 1, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [json.loads(line)["frame"] for line in done.stdout.splitlines()] == [0, 1, 2]


def test_a_still_bracket_can_be_simulated(virest: Virest, tmp_path: Path) -> None:
    """``--auto-exposure 4:2 --rate 0`` gives two exposures 4 EV apart, and the summary states their range."""
    made = virest("simulate", "trip", *SMALL, "--auto-exposure", "4:2", "--rate", 0, "--json", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    facts = json.loads(made.stdout)
    assert facts["auto_exposure_ev"] == 4.0
    assert facts["blur_px"] == 0.0
    low, high = (e * iso for e, iso in zip(facts["exposure_range_ms"], facts["iso_range"], strict=True))
    assert high / low == pytest.approx(16, rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--effect", "time_ofset=1"), 3, "time_offset"),
        (("--scene", "moon"), 3, "leaves"),
        (("--frames", 0), 3, "frames"),
        (("--exposure-ms", "10;20"), 2, "milliseconds"),
        (("--auto-exposure", "much"), 2, "6:9"),
        (("--auto-exposure", "20"), 3, "12"),
        (("--auto-exposure", "3:1"), 3, "at least 2"),
        (("--direction", "up"), 2, "top_to_bottom"),
        (("--isp", "camera"), 3, "phone"),
        (("--sharpen", "1,2,3"), 2, "--sharpen"),
    ],
)
def test_an_invalid_option_gives_one_line(
    virest: Virest, tmp_path: Path, arguments: tuple[object, ...], code: int, says: str
):
    """Nothing is written."""
    result = virest("simulate", "trip", *SMALL, *arguments, cwd=tmp_path)
    assert result.returncode == code
    assert len(result.stderr.splitlines()) == 1
    assert says in result.stderr
    assert not (tmp_path / "trip").exists()


def test_a_folder_that_is_not_a_simulated_capture_is_kept(virest: Virest, tmp_path: Path) -> None:
    """Exit 8, even with ``--overwrite``."""
    (tmp_path / "trip").mkdir()
    (tmp_path / "trip/holiday.jpg").write_text("mine")
    for options in ((), ("--overwrite",)):
        assert virest("simulate", "trip", *SMALL, *options, cwd=tmp_path).returncode == 8
    assert [path.name for path in (tmp_path / "trip").iterdir()] == ["holiday.jpg"]


def test_the_sample_captures_are_small_and_complete() -> None:
    """sample_data/ holds the captures of ``make sample``, less than 12 MB in total."""
    folder = Path(__file__).resolve().parents[2] / "sample_data"
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert {path.parent.name for path in folder.glob("*/movie.mp4")} == set(sample.SAMPLES)
    assert sum(path.stat().st_size for path in files) < 12e6
    for name in sample.SAMPLES:
        kept = {f"{i:06d}.png" for i in sample.KEPT_TRUTH}
        assert {path.name for path in (folder / name / "truth/frames").iterdir()} == kept


def test_a_phones_processing_can_be_simulated_and_changed(virest: Virest, tmp_path: Path) -> None:
    """``--isp phone`` can be combined with individual strengths; the summary names every active step."""
    arguments = ("--isp", "phone", "--sharpen", "1.5,2", "--denoise", 0, "--offset-ms", -3)
    made = virest("simulate", "trip", *SMALL, *arguments, "--json", cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    isp = json.loads(made.stdout)["isp"]
    assert (isp["sharpen"], isp["sharpen_radius_px"], isp["offset_s"]) == (1.5, 2.0, -0.003)
    assert isp["tone"] > 0
    assert "denoise" not in isp
    assert json.loads((tmp_path / "trip/truth/effects.json").read_text())["isp"] == isp


def test_the_help_groups_the_phones_options(virest: Virest, tmp_path: Path) -> None:
    """They have their own heading below the other options."""
    text = virest("simulate", "--help", cwd=tmp_path).stdout
    usual, phones = text.partition("\nOptions:")[2].split("phone's own processing")
    assert "--seed" in usual
    assert "--sharpen" not in usual
    assert all(option in phones for option in ("--isp", "--sharpen", "--gyro-noise", "--bits-per-px"))
