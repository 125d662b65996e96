"""``virest preview``, ``virest doctor`` and ``virest profile``."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import pytest
import yaml

from virest.app import doctor
from virest.camera.phones import READOUTS
from virest.camera.profile_file import read_profile

ROOT = Path(__file__).resolve().parents[2]


def test_a_preview_shows_the_most_blurred_frame(swing: Path, virest_here, tmp_path: Path) -> None:
    """The picture has three panels; ``--frame`` selects another frame; an existing picture is kept."""
    done = virest_here("preview", swing / "movie.mp4", "--json", "--preset", "fast")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    picture = cv2.imread(str(tmp_path / facts["path"]))
    assert picture is not None
    assert picture.shape[1] > 2 * picture.shape[0]
    assert facts["status"] == "restored"
    number = (facts["frame"] + 4) % 10
    other = virest_here("preview", swing, "--frame", number, "--out", "other.png", "--json", "--preset", "fast")
    assert json.loads(other.stdout)["blur_px"] < facts["blur_px"]
    again = virest_here("preview", swing)
    assert again.returncode == 8
    assert "--overwrite" in again.stderr


def test_the_doctor_reports_the_installation(virest_here, monkeypatch: pytest.MonkeyPatch) -> None:
    """All required packages are installed; a missing one is named and gives exit code 1."""
    done = virest_here("doctor", "--json")
    assert done.returncode == 0, done.stdout
    facts = json.loads(done.stdout)
    assert facts["missing"] == []
    assert "h264" in facts["decoders"]
    assert facts["transforms"] in facts["tile_fft_s"]
    assert min(facts["tile_fft_s"].values()) > 0
    monkeypatch.setattr(doctor, "NEEDED", (*doctor.NEEDED, "no-such-package"))
    _, text, code = doctor.examine()
    assert code == 1
    assert text.endswith("missing: no-such-package")


def test_the_doctor_names_the_transforms_used_without_ipp(virest) -> None:
    """If OpenCV may not use IPP, SciPy computes the transforms, and a note says so."""
    facts = json.loads(virest("doctor", "--json", OPENCV_IPP="disabled").stdout)
    assert facts["ipp"] is None
    assert facts["transforms"] == "scipy's pocketfft"
    assert any("IPP" in note for note in facts["notes"])


def test_the_doctor_names_what_is_slow() -> None:
    """Many cores with little memory, slow transforms and missing features each have a note."""
    facts = {"cores": 8, "memory_bytes": 1.5e9, "free_bytes_here": 1e9, "fft_s": 0.05, "vector_instructions": False,
             "decoders": ["h264"], "ipp": None}  # fmt: skip
    notes = " ".join(doctor._notes(facts))
    for word in ("--jobs 4", "vector instructions", "5.0 times", "GB free", "HEVC", "IPP"):
        assert word in notes
    assert "one core" in doctor._notes({"cores": 1, "memory_bytes": None, "free_bytes_here": 1e12})[0]


def test_a_profile_is_created_from_a_capture(tiny: Path, virest_here, tmp_path: Path) -> None:
    """Logged values are filled in, unknown ones are null, and the program can read the file."""
    (tiny / "camera.yaml").unlink()
    done = virest_here("profile", "new", tiny, "--out", "mine.yaml")
    assert done.returncode == 0, done.stderr
    assert "unknown: time offset, response" in done.stdout
    profile = read_profile(tmp_path / "mine.yaml")
    assert profile.intrinsics is not None
    assert (profile.intrinsics.fx_px, profile.shutter.readout_time_s) == (130.0, 0.02)
    assert profile.time_offset_s is None
    assert "# shutter:" in (tmp_path / "mine.yaml").read_text()


def test_a_profile_is_created_for_a_known_phone(virest_here, tmp_path: Path) -> None:
    """The readout time comes with its source; a readout time of another video mode is not used."""
    done = virest_here("profile", "new", "--device", "honor view", "--size", "720x1280", "--fov-deg", "60")
    assert done.returncode == 0, done.stderr
    content = yaml.safe_load((tmp_path / "camera.yaml").read_text())
    assert content["shutter"]["readout_time_s"] == pytest.approx(0.02068)
    assert content["intrinsics"]["fx_px"] == pytest.approx(640 / 3**-0.5)
    assert "kalibr" in content["estimates"]["readout_time_s"]["source"]
    other = virest_here("profile", "new", "--device", "honor view", "--size", "1920x1080", "--out", "b.yaml")
    assert other.returncode == 3
    assert "1280x720" in other.stderr
    unknown = virest_here("profile", "new", "--device", "toaster", "--size", "1920x1080", "--out", "b.yaml")
    assert "virest profile devices" in unknown.stderr
    assert not (tmp_path / "b.yaml").exists()


def test_every_known_readout_is_documented_with_its_source(virest_here) -> None:
    """The documentation lists every entry of the program's table with size and source."""
    page = (ROOT / "docs" / "phones.md").read_text("utf-8")
    for entry in READOUTS:
        assert 0.001 < entry.readout_s < 0.1
        assert f"| {entry.device} | {entry.width}×{entry.height} |" in page
        assert entry.source in page
    done = virest_here("profile", "devices", "galaxy", "--json")
    assert [d["readout_s"] for d in json.loads(done.stdout)["devices"]] == [0.03, 0.03267]


def test_help_shows_no_types_and_truncates_no_description(virest_here) -> None:
    """Arguments have names instead of Python types, and every command's description is complete."""
    shown = virest_here("--help").stdout
    commands = shown.partition("Commands:")[2].strip().splitlines()
    assert all(line.rstrip().endswith(".") and "..." not in line for line in commands)
    for command in ("process", "simulate", "report", "export", "profile new", "evaluate slam"):
        page = virest_here(*command.split(), "--help").stdout
        assert not re.search(r"<(list|str|path|file)", page), command
        assert "Usage: virest" in page
        assert ("-o, --out" in page) == ("--out " in page), command


def test_a_bad_folder_is_reported_in_few_lines(virest_here, tmp_path: Path) -> None:
    """One line lists all missing files."""
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "gyro_accel.csv").write_text("t,x\n")
    done = virest_here("inspect", "bad")
    assert done.returncode == 4
    assert "also missing: movie.mp4, frame_timestamps.txt, movie_metadata.csv" in done.stdout
    assert len(done.stdout.splitlines()) <= 6


def test_a_log_that_looks_clipped_is_named_before_processing(swing: Path, virest_here, tmp_path: Path) -> None:
    """`inspect` and `process` say at which rate, and which command tests it."""
    folder = tmp_path / "clipped"
    shutil.copytree(swing, folder)
    log = folder / "gyro_accel.csv"
    head, *rows = log.read_text(encoding="utf-8").splitlines()
    cells = [row.split(",") for row in rows]
    limit = 0.6 * max(abs(float(row[1])) for row in cells)
    for row in cells:
        row[1] = f"{min(max(float(row[1]), -limit), limit):.7g}"
    log.write_text("\n".join([head, *map(",".join, cells)]) + "\n", encoding="utf-8")
    said = f"the gyroscope log looks clipped at {limit:.3g} rad/s"
    notes, sound = (json.loads(virest_here("inspect", one, "--json").stdout)["notes"] for one in (folder, swing))
    assert [note["severity"] for note in notes if note["text"].startswith(said)] == ["warning"]
    assert not any("looks" in note["text"] for note in sound)
    planned = virest_here("process", folder, "--dry-run", "--preset", "fast")
    assert said in planned.stderr
    assert "virest diagnose" in planned.stderr
