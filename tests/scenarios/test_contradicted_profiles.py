"""Wrong profiles: contradictions by the pictures are reported, and the pictures are not damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from story import Result, process, psnrs_db, simulate

pytestmark = pytest.mark.scenario

OPTIONS = "--width 480 --height 360 --frames 10 --rate 1.5 --exposure-ms 14 --seed"


def said(result: Result, text: str) -> list[str]:
    """Warnings about the whole capture that contain a text."""
    return [warning for warning in result.account["warnings"] if text in warning]


def reasons(result: Result) -> set[str]:
    """All warnings of the frames."""
    return {warning for line in result.lines for warning in line["warnings"]}


def test_an_exposure_twice_too_long_is_replaced_by_the_observed_one(virest, work: Path):
    """Blur shows it roughly, tracked points accurately beside the stated offset; frames are deblurred with it."""
    capture = simulate(virest, work / "stated-long", *OPTIONS.split(), 23, "--effect", "exposure_time=0.5")
    result = process(virest, capture, work / "stated-long-run", "--preset", "fast")
    (warning,) = said(result, "exposures of")
    assert "exposure-scale" in warning
    assert result.account["profile"]["shutter"]["exposure_scale"] == pytest.approx(0.5, abs=0.05)
    assert any(line["deblur"]["method"] != "none" for line in result.lines)
    straight = process(virest, capture, work / "stated-long-straight", "--deblur", "none")
    gain = psnrs_db(result, result, capture) - psnrs_db(straight, result, capture)
    assert gain.mean() > 0.5
    assert gain.min() > -0.1


def test_an_exposure_that_points_do_not_confirm_disables_deblurring(virest, work: Path):
    """The stated offset is wrong too: deblurring would cause ringing; the warning names the command."""
    capture = simulate(virest, work / "stated-both", *OPTIONS.split(), 23, "--effect", "exposure_time=0.5",
                       "--effect", "time_offset=-0.02")  # fmt: skip
    result = process(virest, capture, work / "stated-both-run", "--preset", "fast")
    (warning,) = said(result, "blur paths")
    assert "exposure-scale" in warning
    assert {line["deblur"]["method"] for line in result.lines} == {"none"}
    assert any("blur observed in this frame disagrees" in reason for reason in reasons(result))


def test_a_wrong_offset_is_replaced_by_the_tracked_points_one(virest, work: Path):
    """Frames are restored nearly as with the true profile, and the log gives the offset used and the reason."""
    capture = simulate(virest, work / "stated-late", *OPTIONS.split(), 24, "--effect", "time_offset=-0.02")
    true = process(
        virest, capture, work / "true-run", "--preset", "fast", "--config", capture / "truth" / "camera.yaml"
    )
    result = process(virest, capture, work / "stated-late-run", "--preset", "fast")
    (warning,) = said(result, "time offset")
    assert "used instead of the profile's +0.0 ms" in warning
    found = result.account["profile"]["estimates"]["time_offset_s"]
    assert abs(found["value"] + 0.02) < 4 * found["std"]
    recorded = process(virest, capture, work / "stated-late-raw", "--deblur", "none", "--shutter", "none")
    gain = psnrs_db(result, result, capture) - psnrs_db(recorded, result, capture)
    assert gain.min() > -0.1
    assert np.mean(psnrs_db(result, result, capture) - psnrs_db(true, result, capture)) > -0.3


def test_a_wrong_readout_is_replaced_by_the_tracked_points_one(virest, work: Path):
    """Rows then lie where they do with the right profile, and a stated offset stays."""
    capture = simulate(virest, work / "readout", *OPTIONS.split(), 28, "--frames", 20)
    profile = yaml.safe_load((capture / "camera.yaml").read_text())
    profile["shutter"]["readout_time_s"] *= 0.5
    profile["imu"]["time_offset_s"] = 0.0
    config = work / "readout.yaml"
    config.write_text(yaml.safe_dump(profile))
    settings = ("--deblur", "none", "--frames", "6:14")
    wrong = process(virest, capture, work / "readout-run", *settings, "--config", config)
    right = process(virest, capture, work / "readout-right", *settings)
    assert said(wrong, "readout time of")
    assert not said(wrong, "frames indicate a time offset")
    assert not said(right, "readout time of")
    corners_px = [np.array([line["shutter"]["corners_px"] for line in run.lines]) for run in (wrong, right)]
    assert np.abs(corners_px[0] - corners_px[1]).max() < 0.5


@pytest.mark.parametrize(("scene", "seed"), [("text", 25), ("bright", 26)])
def test_a_correct_profile_is_not_contradicted(virest, work: Path, scene: str, seed: int):
    """No warning concerns clock or blur, and no frame is left alone for such a reason."""
    capture = simulate(virest, work / f"stated-right-{scene}", *OPTIONS.split(), seed, "--scene", scene)
    result = process(virest, capture, work / "stated-right-run", "--preset", "fast")
    assert not said(result, "the pictures")
    assert not any("disagrees with the profile" in reason for reason in reasons(result))


def test_wrong_axes_are_named_and_frames_are_copied(virest, work: Path):
    """The frames rotate like the gyroscope, but about other axes, even though translation might fit the points."""
    options = "--width 480 --height 360 --frames 60 --rate 0.8 --exposure-ms 14 --depth-m 0.5 --seed 29"
    capture = simulate(virest, work / "other-axes", *options.split())
    profile = yaml.safe_load((capture / "camera.yaml").read_text())
    pose = np.array(profile["imu"]["T_cam_imu"])
    profile["imu"] |= {"T_cam_imu": (np.diag([1, -1, 1, 1]) @ pose[[1, 0, 2, 3]]).tolist(), "time_offset_s": None}
    turned = work / "other-axes.yaml"
    turned.write_text(yaml.safe_dump(profile))
    result = process(virest, capture, work / "other-axes-run", "--preset", "fast", "--config", turned)
    assert {line["status"] for line in result.lines} == {"copied"}
    assert said(result, "axes are not the profile's")
    assert "virest calibrate" in result.stderr


def test_a_phone_of_which_nothing_is_known_is_restored(virest, work: Path):
    """A landscape movie of a phone held upright, without camera.yaml, logged focal length or readout time.

    Axes, focal length, offset and readout are found; frames are restored nearly as with the true profile.
    """
    config = work / "upright.yaml"
    profile = yaml.safe_load((simulate(virest, work / "any", "--frames", 2) / "camera.yaml").read_text())
    profile["image"] |= {"width": 320, "height": 240}
    profile["intrinsics"] |= {"fx_px": 280.0, "fy_px": 280.0, "cx_px": 159.5, "cy_px": 119.5}
    profile["imu"]["T_cam_imu"] = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()
    config.write_text(yaml.safe_dump(profile))
    size = ("--width", 320, "--height", 240, "--frames", 18, "--exposure-ms", 8)
    capture = simulate(virest, work / "upright", *OPTIONS.split(), 29, *size, "--config", config)
    stated = process(virest, capture, work / "upright-stated", "--preset", "fast")
    (capture / "camera.yaml").unlink()
    table = capture / "movie_metadata.csv"
    head, *rows = (line.split(",") for line in table.read_text().splitlines())
    for row in rows:
        row[head.index("fx[px]")] = row[head.index("fy[px]")] = "1.0"
        row[head.index("Frame readout time[nanosec]")] = "null"
    table.write_text("\n".join(",".join(row) for row in (head, *rows)) + "\n")
    result = process(virest, capture, work / "upright-run", "--preset", "fast")
    assert said(result, "axes are turned by 90° from the default ones")
    assert said(result, "readout time estimated")
    found = result.account["profile"]
    np.testing.assert_allclose(found["imu"]["T_cam_imu"], profile["imu"]["T_cam_imu"], atol=0.03)
    assert found["intrinsics"]["fx_px"] == pytest.approx(280, rel=0.02)
    readout = found["estimates"]["readout_time_s"]
    assert found["shutter"]["readout_direction"] == profile["shutter"]["readout_direction"]
    assert abs(readout["value"] - profile["shutter"]["readout_time_s"]) < 4 * readout["std"]
    assert np.mean(psnrs_db(result, result, capture) - psnrs_db(stated, result, capture)) > -0.5
