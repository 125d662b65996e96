"""Real phones and cameras: what the pictures determine is reported, and nothing is damaged."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from story import Result, process

from virest.app.diagnose import climb_as_command, open_source
from virest.capture.video import probe_movie, read_frames
from virest.diagnosis.findings import UNEXPLAINED
from virest.evaluation.fidelity import point_distances_px
from virest.inference.tracking import TrackingSettings, TrackPair, track_pairs

pytestmark = pytest.mark.scenario

Picture = np.ndarray[Any, np.dtype[np.uint8]]
CAR_FRAMES = "0:40"
EXPANSION_PX = (442.0, 328.0)
"""The focus of expansion, measured from the set itself (its README.md)."""
DASHBOARD_ROW = 396
TRACKING = TrackingSettings(grid=(16, 12), halve_above_px=2000, min_corner_levels=8.0)
"""Strong corners only, since noise, which restoration reduces, makes none of these."""


def test_a_capture_within_its_start_up_is_restored(virest, realdata: Path, tmp_path: Path):
    """All 25 frames are later than their timestamps; the lag is found and used, and the log has its size."""
    result = process(virest, realdata / "honor_v10", tmp_path, "--preset", "fast")
    counts = result.account["counts"]
    assert counts["failed"] == 0
    assert counts["restored"] >= 22
    assert any("recorder lag" in warning for warning in result.account["warnings"])
    assert result.account["profile"]["extensions"]["frame_lag"]["lag_s"] == pytest.approx(0.31, abs=0.05)
    assert "later content than their timestamps" in result.stderr
    assert_undamaged(result, realdata / "honor_v10")


def test_frames_of_a_car_ride_agree_better_with_a_global_shutter(virest, realdata: Path, tmp_path: Path):
    """Distant points of the restored frames follow a rotation better than those of recorded frames.

    At least 90 % of the frames are restored. The residual of each pair's rotation is measured perpendicular to the
    direction of the focus of expansion, where the car's own motion has no effect.
    """
    capture = realdata / "lhaippp_car"
    result = process(virest, capture, tmp_path, "--preset", "fast", "--frames", CAR_FRAMES)
    restored = [line for line in result.lines if line["status"] == "restored"]
    assert len(restored) >= 0.9 * len(result.lines) == 36
    assert_undamaged(result, capture)
    pairs = [track_pairs(pictures, TRACKING) for pictures in (recorded(capture, 40), restored_frames(result))]
    raw, straight = (residuals_px(tracked, camera_matrix(capture)) for tracked in pairs)
    assert len(straight) > 0.7 * len(raw)
    report = f"median residual: raw {np.median(raw):.4f} px, straightened {np.median(straight):.4f} px"
    print(report)
    assert np.median(straight) < 0.9 * np.median(raw), report
    assert np.quantile(straight, 0.75) < 0.9 * np.quantile(raw, 0.75), report


@pytest.mark.parametrize("name", ["nexus5_162941", "gopro_karma"])
def test_captures_with_many_unknowns_are_processed(virest, realdata: Path, tmp_path: Path, name: str):
    """Unknown focal length, exposure or readout ends no run; warnings name what is missing."""
    result = process(virest, realdata / name, tmp_path, "--preset", "fast", "--frames", "0:12")
    assert len(result.lines) == 12
    assert result.account["counts"]["failed"] == 0
    assert any("unknown" in warning for warning in result.account["warnings"])
    copied = [line for line in result.lines if line["status"] == "copied"]
    assert all(line["warnings"] for line in copied)
    assert_unchanged(result, realdata / name, copied)
    assert_undamaged(result, realdata / name)


def test_a_slow_clock_with_a_stabiliser_is_named(realdata: Path):
    """The clock skew of a hand-shaken phone is known from two more clips.

    Held-out points do not separate its stabiliser from another principal point; a named stabiliser takes most of the
    turns. A large residual remains, since hand and scene are near.
    """
    diagnosis = climb_as_command(open_source(realdata / "nexus5_162941"))
    found = {cause.name: cause.parameters for cause in diagnosis.causes}
    told = found.keys() - {"clock_skew"}
    assert {"clock_skew"} <= found.keys()
    assert told in ({"stabilisation"}, {"principal_point"}, set())
    skew = found["clock_skew"]["clock_skew"]
    assert skew.estimate == pytest.approx(0.005, abs=0.001)
    assert abs(skew.estimate - 0.0053) < 2 * np.hypot(skew.std, 0.0002), (
        "the skew differs from the second clip's 0.0053 ± 0.0002"
    )
    if "stabilisation" in found:
        assert 0.6 < found["stabilisation"]["fraction"].estimate < 1.0
    rivals = {rival.name for cause in diagnosis.causes for rival in cause.rivals}
    assert not told or {"stabilisation", "principal_point"} <= rivals | told
    assert diagnosis.verdict == UNEXPLAINED


def test_a_movie_stabilised_in_the_camera_is_copied(virest, realdata: Path, tmp_path: Path):
    """If the pictures do not follow the gyroscope, the run says so, ends with 0, and copies every covered frame."""
    capture = realdata / "gopro_hero7"
    result = process(virest, capture, tmp_path, "--preset", "fast", "--frames", "0:20")
    assert "the frames do not follow the gyroscope" in result.stderr
    assert any("do not follow" in warning for warning in result.account["warnings"])
    steps = {"deblurred": 0, "straightened": 0, "undistorted": 0}
    assert result.account["counts"] == {"restored": 0, "copied": 18, "skipped": 2, "failed": 0, **steps}
    copied = [line for line in result.lines if line["status"] == "copied"]
    assert_unchanged(result, capture, copied)


# ── helpers ──────────────────────────────────────────────────────────────────────────────────────────────────────


def assert_unchanged(result: Result, capture: Path, copied: list[dict[str, Any]]) -> None:
    """Check that copied frames have exactly the decoded pixels."""
    wanted = {line["frame"]: line for line in copied}
    movie = capture / "movie.mp4"
    for number, picture in read_frames(movie, probe_movie(movie), 0, max(wanted, default=-1)):
        if number in wanted:
            np.testing.assert_array_equal(result.picture(wanted[number]), picture)


def assert_undamaged(result: Result, capture: Path) -> None:
    """Check that restored frames are as bright as the recorded ones and keep most of their corners."""
    wanted = {line["frame"]: line for line in result.lines if line["status"] == "restored"}
    movie = capture / "movie.mp4"
    for number, picture in read_frames(movie, probe_movie(movie), 0, max(wanted, default=-1)):
        if number not in wanted or picture is None:
            continue
        restored, valid_px = result.picture(wanted[number]), wanted[number]["valid_px"]
        assert abs(float(restored.mean()) - float(picture.mean())) < 3, number
        found, all_of_them = (len(point_distances_px(p, picture, valid_px)) for p in (restored, picture))
        assert found > 0.5 * all_of_them, f"frame {number}: {found} of {all_of_them} corners found again"


def camera_matrix(capture: Path) -> np.ndarray:
    """K of a capture's camera.yaml, which has no distortion."""
    lens = yaml.safe_load((capture / "camera.yaml").read_text())["intrinsics"]
    return np.array([[lens["fx_px"], 0, lens["cx_px"]], [0, lens["fy_px"], lens["cy_px"]], [0, 0, 1]])


def recorded(capture: Path, frames: int) -> Iterator[tuple[int, Picture]]:
    """Grey pictures of the movie's first frames."""
    movie = capture / "movie.mp4"
    for number, picture in read_frames(movie, probe_movie(movie), 0, frames - 1):
        assert picture is not None
        yield number, grey(picture)


def restored_frames(result: Result) -> Iterator[tuple[int, Picture]]:
    """Grey pictures that a run wrote."""
    for line in result.lines:
        if line["status"] == "restored":
            yield line["frame"], grey(result.picture(line))


def grey(picture: Picture) -> Picture:
    """Luma of an RGB picture."""
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)


def residuals_px(pairs: Iterable[TrackPair], camera: np.ndarray) -> np.ndarray:
    """Residuals of distant points across the expansion, in all pairs, after each pair's best rotation."""
    left = []
    for pair in pairs:
        far = (pair.points_first_px[:, 1] < DASHBOARD_ROW) & (pair.points_second_px[:, 1] < DASHBOARD_ROW)
        left.append(_left_by_rotation(pair.points_first_px[far], pair.points_second_px[far], camera))
    return np.abs(np.concatenate(left))


def _left_by_rotation(first: np.ndarray, second: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Robust Gauss–Newton over a small rotation vector; the component across the focus of expansion, (n,) px."""
    focal = np.diag(camera)[:2]
    rotation = np.zeros(3)
    weight = np.ones(len(first))
    outward = second - np.array(EXPANSION_PX)
    across = np.stack([-outward[:, 1], outward[:, 0]], -1) / np.linalg.norm(outward, axis=-1, keepdims=True)
    for _ in range(12):
        rays = np.column_stack([(first - camera[:2, 2]) / focal, np.ones(len(first))])
        turned = rays @ cv2.Rodrigues(rotation)[0].T
        x, y = turned[:, 0] / turned[:, 2], turned[:, 1] / turned[:, 2]
        error = second - (np.stack([x, y], -1) * focal + camera[:2, 2])
        slope = np.stack(
            [np.stack([-x * y, 1 + x**2, -y], -1) * focal[0], np.stack([-1 - y**2, x * y, x], -1) * focal[1]], axis=1
        )
        left = np.einsum("ni,ni->n", across, error)
        rows = np.einsum("ni,nij->nj", across, slope)
        scale = max(1.48 * float(np.median(np.abs(left))), 0.02)
        weight = 1 / (1 + (left / (2 * scale)) ** 2)
        rotation = rotation + np.linalg.lstsq(rows * weight[:, None], left * weight, rcond=None)[0]
    return left
