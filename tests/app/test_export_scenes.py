"""Exports for nerfstudio, COLMAP and Gyroflow, checked with pycolmap and with the truth of a simulated walk."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from virest.app.export import ExportOptions, plan_export, run_export
from virest.app.export_scenes import fisheye_coefficients
from virest.app.simulate import simulate_command
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile_file import read_profile
from virest.capture.folder import read_capture
from virest.errors import CaptureError, SettingsError

FRAMES = 8


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera that walks past a wall, with a distorting lens."""
    folder = tmp_path_factory.mktemp("captures") / "walk"
    simulate_command(folder, width=160, height=120, frames=FRAMES, exposure_ms=8.0, seed=5, readout_ms=18, depth_m=2.0,
                     sway_m=0.1, distortion=("radtan", (-0.08, 0.01, 0.001, -0.002, 0.0)))  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def poses(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The true trajectory in TUM's format."""
    rows = np.loadtxt(walk / "truth" / "trajectory.csv", delimiter=",", skiprows=1)
    path = tmp_path_factory.mktemp("poses") / "truth.txt"
    lines = []
    zero_ns = read_capture(walk).stamp_0_ns
    for row in rows:
        quaternion = row[[5, 6, 7, 4]]
        values = " ".join(f"{value:.9f}" for value in (*row[1:4], *quaternion))
        lines.append(f"{zero_ns + round(row[0] * 1e9)} {values}")
    path.write_text("# time x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    return path


def exported(walk: Path, out: Path, **options: object) -> Path:
    """The folder of an export."""
    plan = plan_export(str(walk), ExportOptions(out, **options))  # type: ignore[arg-type]
    run_export(plan)
    return plan.target


def test_pycolmap_reads_the_export(walk: Path, poses: Path, tmp_path: Path) -> None:
    """Camera, images and poses are read as written: pixel centres, world to camera, the lens model."""
    pycolmap = pytest.importorskip("pycolmap")
    folder = exported(walk, tmp_path, format="colmap", poses=poses)
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    assert (model.num_cameras(), model.num_images()) == (1, FRAMES)
    camera = next(iter(model.cameras.values()))
    profile = read_profile(walk / "camera.yaml")
    lens = profile.intrinsics
    assert lens is not None
    assert camera.model.name == "OPENCV"
    rays = np.array([[0.1, -0.2, 1.0], [-0.3, 0.15, 1.0]])
    np.testing.assert_allclose(camera.img_from_cam(rays) - 0.5, lens.project(rays), atol=1e-6)
    shutter = json.loads((folder / "rolling_shutter.json").read_text())
    for image in model.images.values():
        assert (folder / "images" / image.name).is_file()
        given = next(entry for entry in shutter["frames"] if entry["name"] == image.name)
        start, end = (np.array(given[key]["t_cam_world_m"]) for key in ("start", "end"))
        middle = image.cam_from_world().translation
        np.testing.assert_allclose(middle, (start + end) / 2, atol=2e-3)
        assert np.linalg.norm(end - start) > 1e-4


def test_orientations_come_from_the_gyroscope_without_poses(walk: Path, poses: Path, tmp_path: Path) -> None:
    """Rotations between frames agree with the truth; no nerfstudio pose is invented."""
    free = exported(walk, tmp_path / "free", format="colmap")
    true = exported(walk, tmp_path / "true", format="colmap", poses=poses)
    turns = [_turns(folder) for folder in (free, true)]
    assert (turns[1][0].inv() * turns[1][-1]).magnitude() > 0.02
    relative = [t[-1] * t[0].inv() for t in turns]
    assert (relative[0] * relative[1].inv()).magnitude() < 2e-3
    bare = json.loads((exported(walk, tmp_path / "ns", format="nerfstudio") / "transforms.json").read_text())
    assert all("transform_matrix" not in frame for frame in bare["frames"])


def _turns(folder: Path) -> list[Rotation]:
    """World-to-camera rotation of each image of a COLMAP text model."""
    lines = (folder / "sparse" / "0" / "images.txt").read_text().splitlines()
    rows = [line.split() for line in lines if line.endswith(".png")]
    return [Rotation.from_quat([float(v) for v in row[1:5]], scalar_first=True) for row in rows]


def test_nerfstudio_gets_times_motion_and_opengl_poses(walk: Path, poses: Path, tmp_path: Path) -> None:
    """A point ahead of the camera has a negative z in OpenGL's axes; the blur score is in pixels."""
    folder = exported(walk, tmp_path, format="nerfstudio", poses=poses)
    content = json.loads((folder / "transforms.json").read_text())
    lens = read_profile(walk / "camera.yaml").intrinsics
    assert lens is not None
    assert (content["cx"], content["cy"], content["k1"]) == (lens.cx_px + 0.5, lens.cy_px + 0.5, -0.08)
    assert len(content["frames"]) == FRAMES
    model = _turns(exported(walk, tmp_path / "c", format="colmap", poses=poses))
    for frame, turn in zip(content["frames"], model, strict=True):
        matrix = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(turn.as_matrix() @ matrix[:3, :3] @ [0, 0, -1], [0, 0, 1], atol=1e-6)
        assert (frame["exposure_time"], frame["rolling_shutter_time"]) == (0.008, 0.018)
        assert (folder / frame["file_path"]).is_file()
        assert 0 < frame["motion_blur_score"] < 40
        assert len(frame["camera_angular_velocity"]) == 3


def test_a_gyroflow_profile_has_readout_and_lens(walk: Path, tmp_path: Path) -> None:
    """The profile has the readout time in milliseconds and fisheye coefficients that fit the lens."""
    content = json.loads((exported(walk, tmp_path, format="gyroflow") / "lens.json").read_text())
    assert content["frame_readout_time"] == pytest.approx(18.0)
    assert content["calib_dimension"] == {"w": 160, "h": 120}
    assert content["fps"] == pytest.approx(30, abs=0.1)
    assert len(content["fisheye_params"]["distortion_coeffs"]) == 4
    assert content["fisheye_params"]["RMS_error"] < 0.05


def test_fisheye_coefficients_fit_a_lens() -> None:
    """The equidistant model projects rays as the lens does, and a fisheye lens keeps its coefficients."""
    lens = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5, "radtan", (-0.1, 0.02, 0.0, 0.0, 0.0))
    found, error_px = fisheye_coefficients(lens)
    fisheye = Intrinsics(640, 480, 500.0, 500.0, 319.5, 239.5, "fisheye", found)
    rays = np.array([[0.1, 0.05, 1.0], [0.4, -0.3, 1.0], [-0.6, 0.45, 1.0]])
    assert error_px < 0.02
    np.testing.assert_allclose(fisheye.project(rays), lens.project(rays), atol=0.03)
    assert fisheye_coefficients(fisheye) == (found, 0.0)


def test_impossible_exports_are_errors(walk: Path, tmp_path: Path) -> None:
    """An unknown lens and a file that is not a trajectory."""
    (tmp_path / "no.yaml").write_text("virest_profile: 1\nimage: {width: 160, height: 120}\nimu: {time_offset_s: 0}\n")
    (tmp_path / "poses.txt").write_text("1 2 3\n")
    with pytest.raises(SettingsError, match="not a trajectory"):
        exported(walk, tmp_path, format="colmap", poses=tmp_path / "poses.txt")
    metadata = walk / "movie_metadata.csv"
    kept = metadata.read_text()
    try:
        metadata.write_text(kept.replace(kept.splitlines()[1].split(",")[1], "1.0"))
        with pytest.raises(CaptureError, match="focal length is unknown"):
            exported(walk, tmp_path, format="colmap", config=tmp_path / "no.yaml")
    finally:
        metadata.write_text(kept)
