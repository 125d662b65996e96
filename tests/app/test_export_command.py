"""``virest export``: files for SLAM tools, reading an export back, and exports that are refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from virest.app.export import ExportOptions, plan_export, run_export
from virest.app.process import ProcessOptions, process_captures
from virest.app.simulate import simulate_command
from virest.camera.field import Field
from virest.camera.kalibr import is_kalibr, parse_camchain, parse_imu
from virest.camera.profile_file import format_profile, read_profile
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.video import probe_movie, read_frames
from virest.errors import CaptureError, OutputError
from virest.restoration.settings import RestorationSettings

OFFSET_S = 0.0123
FRAMES = 14


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Path:
    """A simulated capture whose profile is the true one, including the clock offset."""
    folder = tmp_path_factory.mktemp("captures") / "walk"
    effects = (f"time_offset={OFFSET_S}", "clock_skew=0.0002")
    simulate_command(
        folder, width=176, height=128, frames=FRAMES, exposure_ms=[6.0, 9.0], seed=4, readout_ms=14, effects=effects,
        response="five_segment",
    )  # fmt: skip
    shutil.copy(folder / "truth" / "camera.yaml", folder / "camera.yaml")
    return folder


@pytest.fixture(scope="module")
def restored(walk, tmp_path_factory) -> Path:
    """A finished run with one skipped frame."""
    out = tmp_path_factory.mktemp("runs")
    assert process_captures([str(walk)], ProcessOptions(out, RestorationSettings(deblur="none"))) == 0
    run = out / "walk"
    lines = [json.loads(line) for line in (run / "parameters.jsonl").read_text().splitlines()]
    lines[3] |= {"status": "skipped", "output": None}
    (run / "frames" / "000003.png").unlink()
    (run / "parameters.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return run


def export(capture: Path, out: Path, **options: object) -> tuple[Path, dict]:
    """Export a capture; return the folder and the facts."""
    facts, _ = run_export(plan_export(str(capture), ExportOptions(out, **options)))  # type: ignore[arg-type]
    return out / capture.name, facts


def frames_of(folder: Path) -> dict[int, np.ndarray]:
    """Every frame of a capture, RGB."""
    capture = read_capture(folder, look_at_pictures=False)
    return dict(read_frames(capture.movie, probe_movie(capture.movie), 0, 999))


@pytest.mark.parametrize("form", ["euroc", "tum"])
def test_an_export_reads_back_the_same(walk, tmp_path, form):
    """Pixels, timestamps, samples and profile are the same.

    Samples use the camera's clock, so offset and skew are zero.
    """
    folder, facts = export(walk, tmp_path, format=form)
    before, after = read_capture(walk), read_capture(folder)
    assert facts["frames"] == len(after.frames) == len(before.usable)
    assert [f.timestamp_ns for f in after.frames] == [f.timestamp_ns for f in before.usable]
    theirs, ours = frames_of(walk), frames_of(folder)
    for number, frame in enumerate(before.usable):
        np.testing.assert_array_equal(ours[number], theirs[frame.index])
    np.testing.assert_array_equal(after.imu.gyro_rad_s, before.imu.gyro_rad_s)
    np.testing.assert_array_equal(after.imu.accel_m_s2, before.imu.accel_m_s2)
    later_s = before.usable[0].time_s
    on_camera_s = (before.imu.time_s - OFFSET_S) / 1.0002 - later_s
    np.testing.assert_allclose(after.imu.time_s, on_camera_s, atol=2e-9)
    was, _ = resolve_profile(before)
    now, source = resolve_profile(after)
    assert source.endswith("camera.yaml")
    assert (now.time_offset_s, now.clock_skew) == (0.0, 0.0)
    for name in ("intrinsics", "shutter", "r_cam_imu", "p_cam_imu_m", "response", "gyro_bias_rad_s", "depth_m"):
        assert getattr(now, name) == getattr(was, name), name
    if form == "euroc":
        assert [f.exposure_s for f in after.frames] == pytest.approx([f.exposure_s for f in before.usable])


def test_every_tool_finds_its_files(walk, tmp_path):
    """Lists, sensor files, camera chain, noise and settings parse, agree, and name existing pictures."""
    folder, facts = export(walk, tmp_path)
    profile, _ = resolve_profile(read_capture(walk))
    assert profile.intrinsics is not None
    names = [line.split(",")[1] for line in (folder / "mav0/cam0/data.csv").read_text().splitlines()[1:]]
    assert sorted(path.name for path in (folder / "mav0/cam0/data").iterdir()) == sorted(names)
    assert (folder / "times.txt").read_text().split() == [name.removesuffix(".png") for name in names]
    sensor = yaml.safe_load((folder / "mav0/cam0/sensor.yaml").read_text())
    assert sensor["intrinsics"][:2] == [profile.intrinsics.fx_px, profile.intrinsics.fy_px]
    body_from_cam = np.array(sensor["T_BS"]["data"]).reshape(4, 4)
    np.testing.assert_allclose(body_from_cam[:3, :3] @ profile.rotation_cam_imu, np.eye(3), atol=1e-12)
    assert sensor["line_delay_nanoseconds"] == pytest.approx(14e6 / 128)
    chain = yaml.safe_load((folder / "camchain-imucam.yaml").read_text())
    assert is_kalibr(chain)
    assert chain["cam0"]["timeshift_cam_imu"] == pytest.approx(facts["instant_after_stamp_s"])
    assert facts["instant_after_stamp_s"] == pytest.approx(0.5 * (0.014 + 0.0075), abs=1.6e-3)
    np.testing.assert_array_equal(parse_camchain(chain).rotation_cam_imu, profile.rotation_cam_imu)
    assert parse_imu(yaml.safe_load((folder / "imu.yaml").read_text())).update_rate_hz == pytest.approx(200, rel=0.01)
    orb = cv2.FileStorage(str(folder / "orb_slam3.yaml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(orb.getNode("IMU.T_b_c1").mat(), body_from_cam, atol=1e-6)
    assert (orb.getNode("Camera.width").real(), orb.getNode("Camera.height").real()) == (176, 128)
    assert json.loads((folder / "export.json").read_text())["frames"] == facts["frames"]


def test_stamps_at_the_middle_of_exposure_and_readout(walk, tmp_path):
    """Each timestamp moves to the middle of its own exposure and readout; the profile states where rows begin."""
    folder, facts = export(walk, tmp_path, stamps="instant")
    assert facts["instant_after_stamp_s"] == 0.0
    before, after = read_capture(walk), read_capture(folder)
    for was, now in zip(before.usable, after.frames, strict=True):
        expected_s = 0.5 * (0.014 + (was.exposure_s or 0.0))
        assert now.timestamp_ns - was.timestamp_ns == pytest.approx(1e9 * expected_s, abs=2)
    profile, _ = resolve_profile(after)
    assert (profile.shutter.timestamp, profile.time_offset_s) == ("exposure_middle", pytest.approx(-0.007))
    chain = yaml.safe_load((folder / "camchain-imucam.yaml").read_text())
    assert chain["cam0"]["timeshift_cam_imu"] == 0.0


def test_an_export_of_restored_frames(walk, restored, tmp_path):
    """Frames of a run are copied, skipped ones are left out, and exported frames have neither readout nor exposure."""
    folder, facts = export(walk, tmp_path, restored=restored)
    assert facts["left_out"] == {"skipped": 1}
    after = read_capture(folder)
    stamps = [frame.timestamp_ns for frame in read_capture(walk).frames]
    assert [frame.timestamp_ns for frame in after.frames] == stamps[:3] + stamps[4:]
    written = cv2.imread(str(folder / f"mav0/cam0/data/{stamps[6]}.png"))
    np.testing.assert_array_equal(written, cv2.imread(str(restored / "frames/000006.png")))
    assert all(frame.exposure_s is None for frame in after.frames)
    profile, _ = resolve_profile(after)
    assert (profile.readout_known, profile.shutter.readout_time_s, profile.time_offset_s) == (True, 0.0, 0.0)
    assert facts["instant_after_stamp_s"] == 0.0  # the start of the first row's exposure, to which the timestamps refer


def test_restored_frames_have_no_readout_in_any_format(walk, restored, tmp_path):
    """Straightened frames show one instant; a readout time would distort them again."""
    files = {"gyroflow": ("lens.json", "frame_readout_time"), "colmap": ("rolling_shutter.json", "readout_time_s")}
    for form, (name, key) in files.items():
        folder, _ = export(walk, tmp_path / form, format=form, restored=restored)
        assert json.loads((folder / name).read_text())[key] == 0.0
    folder, _ = export(walk, tmp_path / "nerf", format="nerfstudio", restored=restored)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert {frame["rolling_shutter_time"] for frame in frames} == {0.0}


def test_a_run_of_another_capture_is_refused(walk, restored, tmp_path):
    """A run must match the capture's name and timestamps; no folder is left behind."""
    other = shutil.copytree(walk, tmp_path / "other")
    with pytest.raises(CaptureError, match="run of 'walk'"):
        export(other, tmp_path / "out", restored=restored)
    twin = shutil.copytree(walk, tmp_path / "twin" / "walk")
    text = (twin / "frame_timestamps.txt").read_text().splitlines()
    stamps = [line.split(",") for line in text[1:]]
    moved = [",".join([str(int(fields[0]) + 1000), *fields[1:]]) for fields in stamps]
    (twin / "frame_timestamps.txt").write_text("\n".join([text[0], *moved]) + "\n")
    with pytest.raises(CaptureError, match="its stamp differs"):
        export(twin, tmp_path / "out", restored=restored)
    with pytest.raises(CaptureError, match="no finished run"):
        export(walk, tmp_path / "out", restored=tmp_path)
    assert not (tmp_path / "out").exists()


def test_existing_files_are_kept(walk, tmp_path):
    """An export is replaced only on request and other folders never; an interrupted export leaves no partial files."""
    folder, _ = export(walk, tmp_path)
    with pytest.raises(OutputError, match="overwrite") as fault:
        export(walk, tmp_path)
    assert fault.value.exit_code == 8
    assert len(list((folder / "mav0/cam0/data").iterdir())) == FRAMES
    export(walk, tmp_path, frames=slice(2, 9), overwrite=True)
    assert len(list((folder / "mav0/cam0/data").iterdir())) == 7
    assert [path.name for path in tmp_path.iterdir()] == ["walk"]
    (folder / "export.json").unlink()
    with pytest.raises(OutputError, match="not a virest export"):
        export(walk, tmp_path, overwrite=True)
    with pytest.raises(OutputError, match="would overwrite"):
        export(walk, walk.parent, overwrite=True)
    plan = plan_export(str(walk), ExportOptions(tmp_path / "new"))

    def stop(_count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_export(plan, stop)
    assert list((tmp_path / "new").iterdir()) == []


def test_unknown_values_are_noted_and_left_out(walk, tmp_path):
    """Without offset and lens the frames are still exported, with notes and without an invented calibration."""
    bare = shutil.copytree(walk, tmp_path / "bare")
    (bare / "camera.yaml").write_text(
        "virest_profile: 1\nimage: {width: 176, height: 128}\nshutter: {readout_time_s: null}\n"
    )
    text = (bare / "movie_metadata.csv").read_text().splitlines()
    place = text[0].split(",").index("fx[px]")
    rows = [",".join("1.0" if k in (place, place + 1) else v for k, v in enumerate(r.split(","))) for r in text[1:]]
    (bare / "movie_metadata.csv").write_text("\n".join([text[0], *rows]) + "\n")
    folder, facts = export(bare, tmp_path / "out")
    assert len(facts["notes"]) >= 2
    assert not (folder / "orb_slam3.yaml").exists()
    assert not (folder / "mav0/cam0/sensor.yaml").exists()
    assert read_profile(folder / "camera.yaml").time_offset_s is None
    assert len(read_capture(folder).usable) == FRAMES


@pytest.mark.scenario
def test_the_program_processes_its_own_export(walk, tmp_path, virest):
    """The command prints one JSON object, ``process`` runs on the export, and usage errors have their exit codes."""
    made = virest("export", walk, "--out", tmp_path, "--format", "euroc", "--json")
    assert made.returncode == 0, made.stderr
    facts = json.loads(made.stdout)
    assert facts["frames"] == FRAMES
    run = virest("process", facts["folder"], "--out", tmp_path / "run", "--preset", "fast", "--json")
    assert run.returncode == 0, run.stderr
    lines = [json.loads(line) for line in run.stdout.splitlines()]
    assert [line["status"] for line in lines] == ["restored"] * FRAMES
    again = virest("export", walk, "--out", tmp_path)
    assert again.returncode == 8
    assert again.stderr.count("error:") == 1
    assert virest("export", walk, "--format", "bag", "--out", tmp_path).returncode == 2
    assert virest("export", tmp_path / "none", "--out", tmp_path).returncode == 4


def test_fields_are_applied_or_noted(walk, tmp_path):
    """A displacement becomes distortion in each format and a rate is added to the samples.

    Times count from the export's start.
    """
    profile = read_profile(walk / "camera.yaml")
    start_ns = read_capture(walk).stamp_0_ns
    across, down = (0.0, 87.5, 175.0), (0.0, 63.5, 127.0)
    bent = tuple((2e-4 * (y - 63.5) ** 2, 0.0) for _ in across for y in down)
    fields = [
        Field("displacement", ("x", "y"), (across, down), bent),
        Field("rate", ("time",), ((0.1, 0.2, 0.3),), ((0.0,) * 3, (0.3, 0.0, -0.2), (0.0,) * 3), (), start_ns),
        Field("scale", ("time",), ((0.0, 1.0),), ((0.0,), (0.02,)), (), start_ns),
    ]
    (tmp_path / "extended.yaml").write_text(format_profile(profile.with_fields(fields)))
    config = tmp_path / "extended.yaml"
    for form in ("colmap", "nerfstudio", "gyroflow"):
        export(walk, tmp_path / form, format=form, config=config)
    folder, facts = export(walk, tmp_path, format="euroc", config=config, frames=slice(2, None))
    assert [note for note in facts["notes"] if "is written as distortion, within" in note]
    assert [note for note in facts["notes"] if "the field of scale over time is left out" in note]
    before, after = read_capture(walk), read_capture(folder)
    added = after.imu.gyro_rad_s - before.imu.gyro_rad_s
    np.testing.assert_allclose(added[np.argmin(np.abs(before.imu.time_s - 0.2))], (0.3, 0.0, -0.2), atol=0.01)
    own, _ = resolve_profile(after)
    assert [field.kind for field in own.fields] == ["displacement", "scale"]
    first_s = (after.stamp_0_ns - start_ns) / 1e9
    (scale,) = own.extensions.field
    np.testing.assert_allclose(scale.at_time(0.3)[0], 0.02 * profile.imu_time_s(first_s + 0.3), atol=1e-5)


def test_samples_are_corrected_for_crooked_axes(walk, tmp_path):
    """The exported samples with the exported profile give the rates of the recorded ones with the given profile."""
    profile = replace(read_profile(walk / "camera.yaml"), gyro_scale=(1.05, 1.0, 0.9), gyro_bias_rad_s=(0.02, 0.0, 0.0))
    profile = profile.with_extensions(gyro_misalignment_rad=(0.03, -0.02, 0.01))
    config = tmp_path / "crooked.yaml"
    config.write_text(format_profile(profile))
    folder, _ = export(walk, tmp_path, format="euroc", config=config)
    before, after = read_capture(walk), read_capture(folder)
    own, _ = resolve_profile(after)
    assert own.extensions.gyro_misalignment_rad == (0.0, 0.0, 0.0)
    true = profile.true_rate_rad_s(before.imu.gyro_rad_s)
    np.testing.assert_allclose(own.true_rate_rad_s(after.imu.gyro_rad_s), true[: len(after.imu)], atol=1e-6)


def test_a_clock_that_wanders_moves_samples_and_no_frame(walk, tmp_path):
    """Frames show the same instants on the camera's clock, whatever the delays of frames and of rows."""
    profile, start_ns = read_profile(walk / "camera.yaml"), read_capture(walk).stamp_0_ns
    late = Field("delay", ("time",), ((0.0, 0.2, 0.4),), ((0.006,), (-0.002,), (0.004,)), (), start_ns)
    uneven = ((0.002,), (0.003,), (0.0,), (0.001,))
    rows = Field("delay", ("row", "time"), ((0.0, 1.0), (0.0, 1.0)), uneven, (), start_ns)
    config = tmp_path / "wandering.yaml"
    config.write_text(format_profile(profile.with_fields([late, rows])))
    even, wandering = (
        plan_export(str(walk), ExportOptions(tmp_path / "out", config=file)) for file in (walk / "camera.yaml", config)
    )
    assert wandering.instant_s == pytest.approx(even.instant_s, abs=1e-9)
    assert np.ptp(wandering.imu_time_ns - even.imu_time_ns) > 5e6
