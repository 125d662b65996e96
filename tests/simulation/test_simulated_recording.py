"""The capture folder: the files of a phone, with consistent timestamps, clocks and truth."""

import json

import cv2
import numpy as np
import pytest
from capture_files import read_imu, read_movie, read_stamps
from scipy.spatial.transform import Rotation

from virest.camera.profile_file import read_profile
from virest.errors import OutputError, SettingsError
from virest.simulation import recording
from virest.simulation.effects import AppliedEffect
from virest.simulation.recording import yuv_planes
from virest.simulation.session import SessionSettings, nominal_camera, plan_session

FILES = {"movie.mp4", "frame_timestamps.txt", "movie_metadata.csv", "gyro_accel.csv", "edge_epochs.txt", "camera.yaml",
         "truth"}  # fmt: skip


def read_truth(folder, kind="frames"):
    """Truth pictures, (n, h, w, 3) RGB as floats."""
    return np.array([cv2.imread(str(p))[..., ::-1] for p in sorted((folder / "truth" / kind).iterdir())]).astype(float)


def luma_of(pictures):
    """Luma in limited range, not rounded."""
    return 16 + (pictures @ [0.299, 0.587, 0.114]) * 219 / 255


def test_the_folder_is_complete(plain_capture):
    """It has all files of the app's layout, camera.yaml and truth/, and nothing temporary."""
    assert {path.name for path in plain_capture.iterdir()} == FILES
    assert len(list(plain_capture.parent.iterdir())) == 1
    assert {p.name for p in (plain_capture / "truth").iterdir()} == {
        "frames",
        "trajectory.csv",
        "camera.yaml",
        "effects.json",
    }


def test_the_truth_file_is_strict_json(tmp_path):
    """Infinities are words and NaN is null; a text that contains the word is unchanged."""
    profile = nominal_camera(32, 32)
    session = plan_session(profile, profile, SessionSettings(frames=1, seed=1))
    odd = {"far": np.inf, "parts": (-np.inf, float("nan"), 1.5), "note": "Infinity"}
    recording.write_recording(session, tmp_path / "odd", applied=(AppliedEffect("scene_depth", odd),))

    def refuse(word):
        raise AssertionError(word)

    truth = json.loads((tmp_path / "odd/truth/effects.json").read_text(), parse_constant=refuse)
    told = truth["effects"][0]["parameters"]
    assert told == {"far": "inf", "parts": ["-inf", None, 1.5], "note": "Infinity"}
    assert truth["scene_plane"]["depth_m"] == "inf"


@pytest.mark.parametrize("fps", [30.0, 29.94, 60.0])
def test_movie_timestamps_are_the_logged_timestamps(fps, simulate):
    """PTS and timestamps differ by less than a microsecond."""
    folder = simulate("pts", fps=fps)
    _, pts = read_movie(folder)
    stamps = read_stamps(folder)
    assert len(pts) == 5
    assert (stamps - stamps[0]) / 1e9 == pytest.approx(pts, abs=1e-6)
    assert np.all(stamps % 1000 == 0)


def test_gyro_integrates_to_the_true_trajectory(simulate):
    """Samples at 1 kHz, in camera axes, are integrated by the exponential of each interval's mean rate."""
    folder = simulate("gyro", imu_rate_hz=1000.0)
    time_ns, gyro, _ = read_imu(folder)
    r_cam_imu = np.array(read_profile(folder / "camera.yaml").r_cam_imu)
    path = np.loadtxt(folder / "truth" / "trajectory.csv", delimiter=",", skiprows=1)
    time_s = (time_ns - read_stamps(folder)[0]) / 1e9
    assert time_s[: len(path)] == pytest.approx(path[:, 0], abs=1e-6)
    turn = Rotation.from_quat(path[0, 4:], scalar_first=True)
    for step, rate in zip(np.diff(time_s), 0.5 * (gyro[1:] + gyro[:-1]) @ r_cam_imu.T, strict=True):
        turn = turn * Rotation.from_rotvec(rate * step)
    last = Rotation.from_quat(path[-1, 4:], scalar_first=True)
    assert (turn.inv() * last).magnitude() < 3e-4


@pytest.mark.parametrize(("width", "height"), [(96, 160), (160, 96)])
def test_the_files_alone_map_one_truth_picture_to_another(width, height, simulate):
    """Gyroscope, T_cam_imu and K map picture 1 to picture 3 by K R K⁻¹, upright and on the side."""
    folder = simulate("warp", width=width, height=height, imu_rate_hz=1000.0, noise_levels=0.0, fps=60.0)
    profile = read_profile(folder / "camera.yaml")
    time_ns, gyro, _ = read_imu(folder)
    stamps = read_stamps(folder)
    turn = Rotation.identity()  # camera at picture 1 from camera at picture 3
    for rate in gyro[(time_ns >= stamps[1]) & (time_ns < stamps[3])] @ np.array(profile.r_cam_imu).T:
        turn = turn * Rotation.from_rotvec(rate * 1e-3)
    lens = profile.intrinsics
    onto = lens.matrix @ turn.as_matrix() @ np.linalg.inv(lens.matrix)
    truth = read_truth(folder)
    carried = cv2.warpPerspective(truth[1], onto, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    inner = (slice(24, -24), slice(24, -24))
    assert np.abs(carried - truth[3])[inner].mean() < 0.4 * np.abs(truth[1] - truth[3])[inner].mean()


def test_the_accelerometer_reads_gravity_up(simulate):
    """It reads about +9.81 along the y of an upright phone, and along x for a phone on its side."""
    upright = read_imu(simulate("up", rate_rad_s=0.0))[2].mean(axis=0)
    side = read_imu(simulate("side", rate_rad_s=0.0, width=128, height=96))[2].mean(axis=0)
    assert upright == pytest.approx([0, 9.81, 0], abs=1e-6)
    assert side == pytest.approx([9.81, 0, 0], abs=1e-6)


def test_imu_samples_surround_the_frames(plain_capture):
    """Samples begin before the first exposure and end after the last."""
    time_ns, _, _ = read_imu(plain_capture)
    stamps = read_stamps(plain_capture)
    assert time_ns[0] < stamps[0] - 3e8
    assert time_ns[-1] > stamps[-1] + 3e8


def test_a_movie_at_rest_equals_the_truth(simulate):
    """Without motion and noise the movie is the truth picture, apart from coding."""
    folder = simulate("rest", rate_rad_s=0.0, noise_levels=0.0, crf=4, width=160, height=96)
    movie, truth = read_movie(folder)[0].astype(float), luma_of(read_truth(folder))
    assert np.abs(movie - truth).mean() < 0.8
    assert abs((movie - truth).mean()) < 0.1


def test_the_movie_is_blurred_and_the_truth_is_sharp(plain_capture):
    """The truth has more gradient energy than the movie."""
    movie, truth = read_movie(plain_capture)[0].astype(float), luma_of(read_truth(plain_capture))
    assert (np.diff(truth, axis=2) ** 2).mean() > 1.3 * (np.diff(movie, axis=2) ** 2).mean()


def test_the_frame_middle_truth_is_another_instant(simulate):
    """``--reference frame-middle`` adds pictures of the middle of readout and exposure."""
    folder = simulate("middle", reference="frame-middle")
    assert np.abs(read_truth(folder, "frame_middle") - read_truth(folder)).mean() > 1.0


def test_the_release_layout_has_no_unix_columns(plain_capture, simulate):
    """Version 2.0 has 7 columns and spaces in the header; the layout of 2021 has 8 and no spaces."""
    old = simulate("old", layout="v2.0")
    assert (old / "gyro_accel.csv").read_text().splitlines()[0] == (
        "Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]"
    )
    assert (old / "frame_timestamps.txt").read_text().splitlines()[0] == "Frame timestamp[nanosec]"
    assert len((old / "movie_metadata.csv").read_text().splitlines()[1].split(",")) == 11
    assert (plain_capture / "gyro_accel.csv").read_text().splitlines()[0].endswith(",az[m/s^2],Unix time[nanosec]")


def test_edge_epochs_relate_an_unknown_camera_clock(plain_capture, simulate):
    """Timestamps plus the mean of both differences equal those of the REALTIME capture."""
    folder = simulate("unknown", clock="UNKNOWN")
    rows = [line.split("\t") for line in (folder / "edge_epochs.txt").read_text().splitlines() if line[0] != "#"]
    shift = sum(int(row[2]) for row in rows) // 2
    assert all(int(a) - int(b) == int(c) for a, b, c in rows)
    assert np.array_equal(read_stamps(folder) + shift, read_stamps(plain_capture))
    assert np.all(read_stamps(folder) > 0)


def test_the_same_seed_gives_the_same_files(plain_capture, simulate):
    """All files have the same bytes; another seed gives another movie."""
    again, other = simulate("again"), simulate("other", seed=4)
    for path in (p.relative_to(again) for p in again.rglob("*") if p.is_file()):
        assert (again / path).read_bytes() == (plain_capture / path).read_bytes(), path
    assert (other / "movie.mp4").read_bytes() != (again / "movie.mp4").read_bytes()


def test_changing_exposures_are_logged_and_used(simulate):
    """Frames use the exposures in turn, and exposure × ISO is constant."""
    folder = simulate("turns", exposure_ms=[4.0, 8.0])
    rows = [line.split(",") for line in (folder / "movie_metadata.csv").read_text().splitlines()[1:]]
    assert [row[4] for row in rows] == ["4000000", "8000000", "4000000", "8000000", "4000000"]
    assert [row[7] for row in rows][:2] == ["144", "72"]
    told = json.loads((folder / "truth" / "effects.json").read_text())
    assert [slot["exposure_s"] for slot in told["slots"]][:2] == [0.004, 0.008]


def test_an_existing_folder_is_refused_without_overwrite(simulate):
    """An output error says so; --overwrite replaces a simulated capture and nothing else."""
    folder = simulate("there")
    with pytest.raises(OutputError, match="not empty"):
        simulate("there")
    simulate("there", overwrite=True)
    (folder / "truth" / "effects.json").unlink()
    with pytest.raises(OutputError, match="something else"):
        simulate("there", overwrite=True)


def test_an_interrupted_simulation_leaves_no_folder(simulate, tmp_path, monkeypatch):
    """The folder appears complete or not at all."""

    def break_down(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(recording, "render_truth", break_down)
    with pytest.raises(KeyboardInterrupt):
        simulate("half")
    assert not list(tmp_path.iterdir())


def test_odd_sizes_are_refused(simulate):
    """H.264 in 4:2:0 needs even sides."""
    with pytest.raises(SettingsError, match="odd"):
        simulate("odd", width=97)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"width": -4}, "valid picture size"),
        ({"height": 0}, "valid picture size"),
        ({"rate_rad_s": np.inf}, "rad/s"),
        ({"noise_levels": np.nan}, "negative rate or noise"),
        ({"pan_rad_s": np.nan}, "a pan of nan"),
        ({"moving_px_s": np.nan}, "objects that move at nan"),
        ({"moving_px_s": np.inf}, "objects that move at inf"),
        ({"moving_px_s": 1e9}, "objects that move at 1e"),
        ({"exposure_ms": np.nan}, "not positive"),
        ({"exposure_ms": 1e300}, "exposure of"),
        ({"readout_ms": np.nan}, "readout_time_s"),
        ({"readout_ms": -1.0}, "readout_time_s"),
        ({"focal_px": 0.0}, "fx_px"),
        ({"focal_px": 1e-300}, "focal length"),
        ({"depth_m": 0.0}, "depth_m"),
        ({"depth_m": -np.inf}, "depth_m"),
        ({"depth_m": 1e8}, "away"),
        ({"effects": ["focal_length=0"]}, "fx_px"),
        ({"effects": ["time_offset=1e5"]}, "time offset"),
        ({"effects": ["readout_time=-1"]}, "readout_time_s"),
        ({"effects": ["exposure_time=0"]}, "exposure_scale"),
        ({"effects": ["frame_lag=-1"]}, "lag_s"),
        ({"effects": ["defocus=-1"]}, "sigma_px"),
    ],
)
def test_impossible_settings_are_refused(simulate, asked, said):
    """The settings error names the quantity, instead of a fault in the renderer, an empty picture or huge arrays."""
    with pytest.raises(SettingsError, match=said):
        simulate("impossible", **asked)


@pytest.mark.parametrize("scene", ["colours", "bright", "board", "text", "photographs"])
def test_every_scene_can_be_simulated(scene, simulate):
    """Each kind has contrast, and only the bright one clips a few per cent of the picture."""
    truth = read_truth(simulate(scene, scene=scene, frames=1, depth_m=1.2, tilt_deg=(10.0, -5.0)))
    assert truth.std() > 20
    assert (0.005 < (truth == 255).mean() < 0.15) == (scene == "bright")


def test_known_colours_have_known_yuv_values():
    """In BT.601 limited range grey 128 has Y 126, and pure red is 81, 90, 240."""
    picture = np.zeros((4, 8, 3), np.uint8)
    picture[...] = 128
    assert set(np.unique(yuv_planes(picture)[:4])) == {126}
    picture[...] = (255, 0, 0)
    planes = yuv_planes(picture).ravel()
    assert (planes[0], planes[32], planes[40]) == (81, 90, 240)


def test_chroma_is_sampled_at_the_left_luma_column():
    """A step of colour between columns 3 and 4 reaches the chroma sample of column 4 with a weight of 3/4."""
    picture = np.zeros((2, 8, 3), np.uint8)
    picture[:, 4:] = (0, 0, 255)
    chroma = yuv_planes(picture).ravel()[16:20].astype(float) - 128
    assert chroma / chroma[3] == pytest.approx([0, 0, 0.75, 1.0], abs=0.01)
