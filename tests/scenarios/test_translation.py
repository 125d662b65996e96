"""A hand swaying near a wall: displacement and depth from the capture, or rotation only, with the reason."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp
from story import Picture, Result, process, truth_picture

from virest.app.simulate import simulate_command
from virest.app.slam_captures import SlamCapture, make_capture
from virest.camera.profile import CameraProfile
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.records import Capture
from virest.capture.video import probe_movie, read_frames, read_gray
from virest.evaluation.fidelity import psnr_db
from virest.image_formation.row_motion import FrameTranslation, frame_times_s
from virest.restoration.capture import RestorationPlan, restore_frames
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.frame import RestoredFrame
from virest.restoration.settings import PRESETS

pytestmark = pytest.mark.scenario

SETTINGS = PRESETS["fast"]
CHOSEN = range(4, 48, 14)
USUAL: dict[str, Any] = {"frames": 48, "noise_levels": 1.5, "bitrate_bits_per_px": 0.6, "exposure_ms": 10.0}
SWAYS: dict[str, dict[str, Any]] = {
    "landscape": {"width": 512, "height": 384, "seed": 311, "depth_m": 1.5, "sway_m": 0.08, "tilt_deg": (12.0, -18.0)}
    | {"rate_rad_s": 0.6, "effects": ["time_offset=0.011"]},
    "portrait": {"width": 384, "height": 512, "seed": 312, "depth_m": 2.0, "sway_m": 0.08, "tilt_deg": (-15.0, 10.0)}
    | {"rate_rad_s": 0.8, "effects": ["time_offset=-0.007"]},
}


@dataclass(frozen=True)
class Story:
    """A capture whose profile lacks only the depth."""

    capture: Capture
    profile: CameraProfile

    @property
    def truth(self) -> dict[int, FrameTranslation]:
        """Velocity, acceleration and the scene's plane of each frame, from the true trajectory in world axes."""
        table = np.loadtxt(self.capture.folder / "truth" / "trajectory.csv", delimiter=",", skiprows=1)
        turn = Slerp(table[:, 0], Rotation.from_quat(table[:, 4:8], scalar_first=True))
        position = CubicSpline(table[:, 0], table[:, 1:4])
        plane = json.loads((self.capture.folder / "truth" / "effects.json").read_text())["scene_plane"]
        normal, foot = np.array(plane["normal"]), np.array([0, 0, plane["depth_m"]])
        found = {}
        for frame in self.capture.frames:
            _, at_s = frame_times_s(self.profile, frame.time_s, frame.exposure_s, SETTINGS.reference)
            to_camera = turn(at_s).as_matrix().T
            nearness = to_camera @ normal / (normal @ (foot - position(at_s)))
            velocity, acceleration = (to_camera @ position(at_s, order) for order in (1, 2))
            found[frame.index] = FrameTranslation(velocity, acceleration, nearness, 1 / nearness[2], "triangulated")
        return found

    def plan(self, **changes: Any) -> RestorationPlan:
        """The plan of process for the capture."""
        index = probe_movie(self.capture.movie)

        def read(numbers: Sequence[int]) -> Iterator[tuple[int, Any]]:
            yield from read_gray(self.capture.movie, index, numbers)

        return plan_restoration(self.capture, replace(self.profile, **changes), SETTINGS, read)

    def restored(self, plan: RestorationPlan, chosen: range = CHOSEN) -> list[RestoredFrame]:
        """The chosen frames, restored."""
        movie = self.capture.movie
        pictures = dict(read_frames(movie, probe_movie(movie), 0, max(chosen)))
        return list(restore_frames([(self.capture.frames[k], pictures[k]) for k in chosen], self.capture.imu, plan))

    def psnr_db(self, plan: RestorationPlan, chosen: range = CHOSEN) -> np.ndarray[Any, Any]:
        """PSNR of the chosen frames against truth, away from the edges."""
        return self.psnrs_db(self.restored(plan, chosen))

    def psnrs_db(self, frames: list[RestoredFrame]) -> np.ndarray[Any, Any]:
        """PSNR of restored frames against truth, away from the edges."""
        found = []
        for restored in frames:
            truth = truth_picture(self.capture.folder, restored.frame.index)
            assert restored.picture is not None
            found.append(psnr_db(restored.picture, truth, (30, 30, truth.shape[1] - 30, truth.shape[0] - 30)))
        return np.array(found)


@pytest.fixture(scope="module")
def story(work: Path) -> Callable[[str], Story]:
    """Simulate each capture once; its profile is the true one without the depth."""
    made: dict[str, Story] = {}

    def make(name: str) -> Story:
        if name not in made:
            folder = work / f"sway_{name}"
            simulate_command(folder, **USUAL, **SWAYS[name])
            capture = read_capture(folder)
            profile = resolve_profile(capture, folder / "truth" / "camera.yaml")[0]
            made[name] = Story(capture, replace(profile, depth_m=None))
        return made[name]

    return make


def require_close(found: RestorationPlan, story: Story, velocity: float = 0.1, depth: float = 0.05) -> None:
    """Check velocities (RMS error over RMS) and depths (each frame) against truth."""
    assert found.translations is not None, found.warnings
    assert len(found.translations) == len(story.capture.frames)
    true = story.truth
    v, t = (np.array([of[k].velocity_m_s for k in true]) for of in (found.translations, true))
    assert math.sqrt(((v - t) ** 2).sum() / (t**2).sum()) < velocity
    ratio = np.array([found.translations[k].inverse_depth_plane[2] / true[k].inverse_depth_plane[2] for k in true])
    np.testing.assert_allclose(ratio, 1, atol=depth)


def test_estimated_translation_restores_as_well_as_the_true_one(story: Callable[[str], Story]):
    """Velocities are within 10 % and depths within 5 %.

    Frames gain 6 dB over rotation and are within 0.2 dB of the truth.

    At most one frame, at the limit of deblurring, may be deblurred with one translation and not with the other.
    """
    told = story("portrait")
    plan = told.plan()
    require_close(plan, told)
    assert {t.source for t in (plan.translations or {}).values()} == {"triangulated"}
    assert not any("rotation only" in warning for warning in plan.warnings)
    frames = [told.restored(replace(plan, translations=t)) for t in (None, plan.translations, told.truth)]
    turned, found, true = map(told.psnrs_db, frames)
    assert (found - turned).mean() > 6, found - turned
    assert (found - turned).min() > -0.1
    methods = [[frame.parameters["deblur"]["method"] for frame in way] for way in frames[1:]]
    alike = np.array([one == other for one, other in zip(*methods, strict=True)])
    assert np.count_nonzero(alike) >= len(alike) - 1
    assert (true - found)[alike].max() < 0.2


def test_an_unknown_offset_is_estimated_too(story: Callable[[str], Story]):
    """Clock, velocity and depth come from one fit if the profile has none of them."""
    told = story("landscape")
    plan = told.plan(time_offset_s=None)
    assert plan.copy_reason is None
    assert plan.profile.time_offset_s == pytest.approx(0.011, abs=2e-4)
    assert plan.profile.estimates["time_offset_s"].std < 1e-3
    require_close(plan, told)


def test_a_depth_in_the_profile_is_used(story: Callable[[str], Story]):
    """The velocity is still estimated from the capture; at infinite depth nothing is estimated."""
    told = story("portrait")
    plan = told.plan(depth_m=2.0)
    require_close(plan, told, depth=0.06)
    assert {(t.depth_m, t.source) for t in (plan.translations or {}).values()} == {(2.0, "profile")}
    far = told.plan(depth_m=math.inf)
    assert far.translations is None
    assert not any("rotation only" in warning for warning in far.warnings)


def test_accelerations_a_sample_late_do_not_matter(story: Callable[[str], Story]):
    """Shifting the accelerometer by one row changes neither velocity nor depth noticeably."""
    told = story("landscape")
    imu = told.capture.imu
    late = replace(imu, accel_m_s2=np.roll(imu.accel_m_s2, 1, axis=0))
    require_close(Story(replace(told.capture, imu=late), told.profile).plan(), told)


def test_objects_in_front_of_a_wall_are_restored_at_their_depth(work: Path):
    """On a walk past them, their surface gains 1 dB over the wall's plane, and no frame becomes worse."""
    walk = SlamCapture(
        "things", "before a wall", width=480, height=360, focal_px=400.0, readout_ms=27.0, exposure_ms=6.0, frames=24,
        walk_m=(0.35, -0.06, 0.08), depth_m=3.0, near_m=1.1, tilt_deg=(9.0, -13.0), seed=63,
    )  # fmt: skip
    folder = make_capture(walk, work / "things")
    capture = read_capture(folder)
    told = Story(capture, replace(resolve_profile(capture, folder / "truth" / "camera.yaml")[0], depth_m=None))
    plan = told.plan()
    assert plan.translations is not None, plan.warnings
    flat = replace(plan, translations={k: replace(t, relief=None) for k, t in plan.translations.items()})
    plane, surface = (told.psnr_db(p, range(3, 24, 6)) for p in (flat, plan))
    assert (surface - plane).min() > 0, surface - plane
    assert (surface - plane).mean() > 1, surface - plane


# ── as the program runs ──────────────────────────────────────────────────────────────────────────────────────────


def with_depth(capture: Path, out: Path, depth: str | None) -> Path:
    """A copy of the true profile with another depth."""
    profile = yaml.safe_load((capture / "truth" / "camera.yaml").read_text(encoding="utf-8"))
    profile["scene"]["depth_m"] = depth
    out.write_text(yaml.safe_dump(profile), encoding="utf-8")
    return out


def run(virest: Any, capture: Path, out: Path, depth: str | None, *options: object) -> Result:
    """Process a few frames with a profile of this depth."""
    out.mkdir(parents=True, exist_ok=True)
    config = with_depth(capture, out / "camera.yaml", depth)
    return process(virest, capture, out, "--preset", "fast", "--frames", "8:40:13", "--config", config, *options)


def pictures(result: Result) -> list[Picture]:
    """All pictures of a run."""
    return [result.picture(line) for line in result.lines]


def test_the_log_does_not_depend_on_the_number_of_jobs(virest, work: Path, story: Callable[[str], Story]):
    """Depth and velocity of every frame and the pictures are the same with one process and with two."""
    told = story("landscape")
    folder = told.capture.folder
    one = run(virest, folder, work / "one", None)
    two = run(virest, folder, work / "two", None, "--jobs", 2)
    truth = told.truth
    for line, other, a, b in zip(one.lines, two.lines, pictures(one), pictures(two), strict=True):
        assert line["depth_source"] == "triangulated"
        assert line["depth_m"] == pytest.approx(truth[line["frame"]].depth_m, rel=0.05)
        assert np.linalg.norm(line["motion"]["velocity_m_s"]) > 0
        assert {**line, "seconds": 0} == {**other, "seconds": 0}
        np.testing.assert_array_equal(a, b)
    assert not any("rotation only" in warning for line in one.lines for warning in line["warnings"])


REFUSED = {
    "still": {"rate_rad_s": 0.0, "sway_m": 0.0, "depth_m": 1.5},
    "turning": {"rate_rad_s": 1.0, "sway_m": 0.0, "depth_m": 1.5},
    "shuffled": {"rate_rad_s": 0.8, "sway_m": 0.07, "depth_m": 1.7, "tilt_deg": (10.0, -12.0)},
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_undetermined_translation_restores_by_rotation_alone(virest, work: Path, name: str):
    """The log gives the reason, and the pictures are exactly those of a scene at infinity."""
    folder = work / f"refused_{name}"
    size = {"width": 320, "height": 240, "frames": 45}
    simulate_command(folder, **{**USUAL, **size, "seed": 77, "truth_frames": False, **REFUSED[name]})
    if name == "shuffled":
        shuffle(folder / "gyro_accel.csv")
    refused = run(virest, folder, work / f"{name}_null", None)
    rotation = run(virest, folder, work / f"{name}_inf", "inf")
    assert any("rotation only (" in warning for warning in refused.account["warnings"]), refused.account["warnings"]
    for line, a, b in zip(refused.lines, pictures(refused), pictures(rotation), strict=True):
        assert line["depth_source"] == "none"
        assert line["depth_m"] is None
        assert line["motion"]["velocity_m_s"] is None
        np.testing.assert_array_equal(a, b)


def shuffle(log: Path) -> None:
    """Shift the accelerations by a second relative to everything else."""
    table = pd.read_csv(log, dtype=str)
    columns = [name for name in table.columns if name.startswith("a")]
    table[columns] = np.roll(table[columns].to_numpy(), 200, axis=0)
    table.to_csv(log, index=False)
