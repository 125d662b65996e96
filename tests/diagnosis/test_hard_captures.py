"""Captures with little information give a verdict with a reason."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis.strange_phone import Strange, StrangePhone
from motion.synthetic_tracks import Recording, Setup
from scipy.spatial.transform import Rotation

from virest.app.bench.broken import _fill, _header
from virest.app.bench.diagnosis import diagnose_folder
from virest.app.simulate import simulate_command
from virest.camera.profile import CameraProfile
from virest.capture.records import Frame
from virest.diagnosis import photometry_fit
from virest.diagnosis.ambiguities import offset_as_timestamp, offset_beside_averaging
from virest.diagnosis.candidates import FarStart
from virest.diagnosis.findings import CONSISTENT, GEOMETRY, Finding, HeldOutGain, ParameterChange
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS
from virest.diagnosis.geometric_evidence import Model, make_evidence
from virest.diagnosis.geometric_ladder import climb, differ_by_delay
from virest.diagnosis.geometric_significance import p_if_plausible
from virest.diagnosis.local_blur import MEMORY, _recent
from virest.diagnosis.local_blur_model import transfers
from virest.diagnosis.local_blur_spectra import bin_count, join_ratios
from virest.diagnosis.photometry_effects import GainDrift
from virest.diagnosis.photometry_fit import fit_photometry, significance
from virest.diagnosis.picture_ladder import changes_of, frames_of, values_of
from virest.diagnosis.residual_tests import points_left
from virest.diagnosis.tracking_stage import TrackedPoints, stands_out_across, with_null_values
from virest.inference import profile_terms as terms_of
from virest.motion.integration import integrate_gyro

HAND = Setup(seed=61, frames=37, points=15, readout_direction="top_to_bottom", gyro_noise_rad_s=0.001)


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A camera on a tripod."""
    folder = tmp_path_factory.mktemp("rest") / "rest"
    simulate_command(folder, width=240, height=320, frames=20, seed=5, rate_rad_s=0.0)
    return folder


def test_a_camera_at_rest_is_consistent_without_exposures(at_rest: Path) -> None:
    """Nothing is fitted to points that do not move, and the notes name unknown exposures as a reason."""
    log = at_rest / "movie_metadata.csv"
    exposure = next(k for k, name in enumerate(_header(log)) if "xposure" in name)
    partial(_fill, log.name, exposure, "null")(at_rest)
    found = diagnose_folder(at_rest)
    assert (found.verdict, found.causes) == (CONSISTENT, ())
    assert any("at rest" in note for note in found.notes)
    assert any("known exposures" in note and "blur was not tested" in note for note in found.notes)


def test_a_filter_above_the_log_s_nyquist_frequency_is_a_delay() -> None:
    """Statistics of blocks alone would tell them apart by the tracker's own errors."""

    def end(name: str, cutoff_hz: float = 0.0) -> SimpleNamespace:
        profile = CameraProfile(64, 48).with_extensions(gyro_lowpass_hz=cutoff_hz)
        return SimpleNamespace(accepted=[SimpleNamespace(name=name)], model=SimpleNamespace(profile=profile))

    for cutoff_hz, name, expected in ((190.0, "time_offset", True), (60.0, "time_offset", False), (190.0, "k1", False)):
        assert differ_by_delay(end(name), end("gyro_lowpass", cutoff_hz), 100.0) is expected  # type: ignore[arg-type]


class BoardBeforeWall(StrangePhone):
    """Points in the middle of the picture are on a board before the wall, at rest or moving on their own."""

    moves = False

    def _on_board(self, way: np.ndarray) -> np.ndarray:
        middle = self.orientation(np.array([self.stamp_s.mean()])).inv().apply(way)
        return np.asarray((np.abs(middle[:, :2] / middle[:, 2:]) < (0.22, 0.28)).all(axis=1))

    def _inverse_depth(self, way: np.ndarray, start: np.ndarray) -> np.ndarray:
        wall = super()._inverse_depth(way, start)
        return wall if self.moves else np.where(self._on_board(way), 0.9, wall)

    def _project(self, way: np.ndarray, start: np.ndarray, inverse: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        seen = super()._project(way, start, inverse, time_s)
        own = np.stack([30 * np.sin(3 * time_s), 20 * np.cos(2 * time_s)], axis=-1)
        return seen + own * self._on_board(way)[:, None] * self.moves


@pytest.mark.parametrize("moves", [False, True])
def test_a_board_before_a_wall_does_not_move_independently(moves: bool) -> None:
    """Its points differ from the wall's along the parallax alone; those of a moving object do not."""
    setup = replace(HAND, points=60, sway_m=0.15, plane_per_m=(0.0, 0.0, 0.33), accel_bias_m_s2=(0.0, 0.0, 0.0))
    phone = BoardBeforeWall(setup, Strange())
    phone.moves = moves
    start = replace(phone.profile, depth_m=None)
    points = TrackedPoints(phone.capture, phone.observed, start, (), (), FarStart(), 1)
    found = points.climbed(lambda _: None)
    assert not found.accepted
    assert (found.independent_share > 0.1) == moves
    assert not moves or any("move independently" in note for note in found.notes)
    assert not moves or points_left(found).only_strays


def test_points_at_another_depth_stand_out_along_the_parallax_alone(rng: np.random.Generator) -> None:
    """A motion of their own stands out across it too; without parallax nothing tells a depth."""
    along_px = rng.normal(size=(400, 2))
    noise_px, part = np.full(400, 0.1), np.arange(400) < 80
    nearer = rng.normal(0, 0.1, (400, 2)) + part[:, None] * 2.0 * along_px
    moving = rng.normal(0, 0.1, (400, 2)) + part[:, None] * np.array([1.5, -0.5])
    for left, way, stands_out in ((nearer, along_px, False), (moving, along_px, True), (nearer, None, True)):
        fitted = SimpleNamespace(along_px=way, difference_px=left, noise_px=noise_px)
        assert stands_out_across(fitted, part) is stands_out  # type: ignore[arg-type]


@pytest.mark.parametrize("turned_deg", [(90, 0, 0), (0, 0, 180), (0, -90, 90)])
def test_a_sensor_mounted_at_a_right_angle_is_the_only_cause(turned_deg: tuple[float, float, float]) -> None:
    """A fit cannot rotate by 90°; comparing rotations of frames and log gives the axes."""
    camera = Recording(replace(HAND, frames=49))
    turned = Rotation.from_euler("ZYX", turned_deg, degrees=True).as_matrix() @ camera.profile.rotation_cam_imu
    other = replace(camera.profile, r_cam_imu=tuple(map(tuple, turned.tolist())))
    capture = SimpleNamespace(imu=camera.imu, repeats=())
    start, terms, _, far, _ = with_null_values(camera.observed, capture, other)  # type: ignore[arg-type]
    verdict = climb(make_evidence(camera.imu, camera.observed), start, terms, (), far)
    assert [entry.name for entry in verdict.accepted] == ["imu_rotation"]
    assert verdict.model.profile.rotation_cam_imu == pytest.approx(camera.profile.rotation_cam_imu, abs=2e-3)


def test_a_movie_stored_upside_down_before_a_wall_is_explained() -> None:
    """Axes and readout are reversed, and the wall must lie in front of the camera with the true axes."""
    camera = Recording(replace(HAND, frames=49, sway_m=0.03, plane_per_m=(0.1, -0.05, 0.6), noise_px=0.05))
    over = np.diag([-1.0, -1.0, 1.0]) @ camera.profile.rotation_cam_imu
    other = replace(camera.profile, r_cam_imu=tuple(map(tuple, over.tolist())))
    other = replace(other.with_shutter(readout_direction="bottom_to_top"), depth_m=None)
    capture = SimpleNamespace(imu=camera.imu, repeats=())
    start, terms, _, far, _ = with_null_values(camera.observed, capture, other)  # type: ignore[arg-type]
    verdict = climb(make_evidence(camera.imu, camera.observed), start, terms, (), far)
    assert {entry.name for entry in verdict.accepted} == {"imu_rotation", "readout_direction"}
    assert verdict.final_rms_px < 1.5 * camera.setup.noise_px
    assert verdict.model.profile.rotation_cam_imu == pytest.approx(camera.profile.rotation_cam_imu, abs=2e-3)


@pytest.mark.parametrize("factor", [0.55, 2.5])
def test_the_focal_length_of_another_lens_is_the_only_cause(factor: float) -> None:
    """The capture is from an ultra-wide or telephoto lens and the profile from the main one."""
    camera = Recording(replace(HAND, frames=49))
    lens = camera.profile.intrinsics
    assert lens is not None
    other = replace(camera.profile, intrinsics=replace(lens, fx_px=lens.fx_px / factor, fy_px=lens.fy_px / factor))
    verdict = climb(make_evidence(camera.imu, camera.observed), other, (), ())
    assert [entry.name for entry in verdict.accepted] == ["focal_length"]
    assert verdict.model.profile.intrinsics is not None
    assert verdict.model.profile.intrinsics.fx_px == pytest.approx(lens.fx_px, rel=2e-3)


def test_frames_before_the_inertial_data_keep_their_numbers(tmp_path: Path) -> None:
    """A gyroscope that starts 0.15 s late excludes the first frames without renumbering the others."""
    folder = tmp_path / "late"
    simulate_command(folder, width=240, height=320, frames=26, seed=3, rate_rad_s=1.0, exposure_ms=8)
    begin_ns = int((folder / "frame_timestamps.txt").read_text(encoding="utf-8").splitlines()[1].split(",")[0])
    log = folder / "gyro_accel.csv"
    head, *rows = log.read_text(encoding="utf-8").splitlines()
    late = [row for row in rows if int(row.split(",")[0]) > begin_ns + 150_000_000]
    log.write_text("\n".join([head, *late]) + "\n", encoding="utf-8")
    found = diagnose_folder(folder)
    assert found.verdict == CONSISTENT
    assert found.nominal.blur_rms_px is not None


def test_a_frame_without_exposure_or_imu_is_replaced_by_the_next() -> None:
    """The encoder's memory of such a frame cannot be predicted."""
    frames = [Frame(k, 10**9 * k, 0.03 * k, 0.01) for k in range(6)]
    frames[3] = replace(frames[3], skip_reason="no IMU", skip_codes=("no-imu",))
    frames[2] = replace(frames[2], exposure_s=None)
    assert [frame.index for frame in _recent(frames, 5)] == [5, 4, 4][:MEMORY]
    assert [frame.index for frame in _recent(frames, 1)] == [1, 0, 0][:MEMORY]


def test_no_tiles_have_no_transfers() -> None:
    """An empty table of spectra keeps its shape."""
    camera = Recording(HAND)
    trajectory = integrate_gyro(camera.imu, camera.profile)
    assert transfers(join_ratios([]), camera.profile, trajectory).shape == (0, 2, MEMORY, bin_count())


def test_gains_of_frames_without_patches_are_unknown(rng: np.random.Generator, monkeypatch) -> None:
    """Such frames take their neighbours' gain, with an unknown deviation."""
    from diagnosis.test_photometry import FRAMES, NOMINAL, hidden, made_observations

    gain = np.exp(0.1 * np.sin(0.4 * np.arange(FRAMES)))
    observed = made_observations(hidden(gain=tuple(gain / np.median(gain))), rng)
    monkeypatch.setattr(photometry_fit, "_PER_FRAME", 30)
    rare = np.isin(observed.frame, (10, 11, 12)) & ((observed.place // 2) % 4 == 0)
    observed = observed.subset(~rare)
    effect = GainDrift(tuple(range(FRAMES)), FRAMES)
    fit = fit_photometry(observed, NOMINAL, [effect])
    assert significance(fit, "gain_drift", observed, NOMINAL)[1] < 1e-6
    std = np.sqrt(np.diag(fit.of("gain_drift")[1]))
    change = changes_of(values_of(effect, NOMINAL), values_of(effect, fit.profile), std, frames_of(fit))["gain"]
    assert len(change.estimate) == FRAMES
    assert np.flatnonzero(np.isnan(change.std)).tolist() == [10, 11, 12]
    np.testing.assert_allclose(np.log(change.estimate[9:14]), np.log(gain[9:14] / np.median(gain)), atol=0.04)


def test_frames_of_another_motion_determine_no_unknown_values() -> None:
    """If frames do not follow the gyroscope, unknown readout, lens and offset are not fitted."""
    camera, other = Recording(replace(HAND, frames=80)), Recording(replace(HAND, seed=8, frames=80))
    unknown = replace(camera.profile, intrinsics=None, time_offset_s=None, readout_known=False)
    stranger = SimpleNamespace(imu=other.imu, repeats=())
    _, terms, notes, _, follows = with_null_values(camera.observed, stranger, unknown)  # type: ignore[arg-type]
    assert not follows
    assert terms == []
    assert any("initial guess" in note for note in notes)
    own = SimpleNamespace(imu=camera.imu, repeats=())
    assert {term.name for term in with_null_values(camera.observed, own, unknown)[1]} == {  # type: ignore[arg-type]
        "focal_length", "readout_time", "time_offset",
    }  # fmt: skip


def test_a_value_at_its_physical_limit_is_not_a_cause() -> None:
    """A readout time of 0.29 ms is significant but impossible for a sensor."""
    camera = Recording(HAND)
    evidence = make_evidence(camera.imu, camera.observed)
    effect = next(effect for effect in GEOMETRIC_EFFECTS if effect.name == "readout_time")
    shutter = camera.profile.shutter
    for readout_s, expected in ((2.9e-4, True), (0.015, False)):
        found = replace(camera.profile, shutter=replace(shutter, readout_time_s=readout_s))
        model = Model(found, None, (terms_of.TIME_OFFSET, effect.term))  # type: ignore[arg-type]
        fitted = evidence.fit(model, model.terms, evidence.table(model, 400))
        assert (p_if_plausible(evidence, fitted, effect, found, camera.profile) == 1.0) is expected


def test_an_unknown_readout_of_the_other_direction_is_reversed() -> None:
    """The fit passes through zero; a negative readout time becomes a positive one in the other direction."""
    camera = Recording(HAND)
    evidence = make_evidence(camera.imu.between(-0.2, camera.stamp_s[-1] + 0.25), camera.observed)
    shutter = replace(camera.profile.shutter, readout_time_s=0.0, readout_direction="bottom_to_top")
    start = replace(camera.profile, shutter=shutter, readout_known=False)
    found = climb(evidence, start, (terms_of.TIME_OFFSET, terms_of.READOUT), (), max_rungs=0).model.profile
    assert found.shutter.readout_direction == "top_to_bottom"
    assert found.shutter.readout_time_s == pytest.approx(camera.profile.shutter.readout_time_s, abs=1e-3)


def test_an_offset_without_exposures_has_the_exposure_as_rival() -> None:
    """Unknown exposures could also explain an offset."""
    change = {"time_offset_s": ParameterChange(0.0, 0.004, 1e-5)}
    finding = Finding("time_offset", change, HeldOutGain(GEOMETRY, 1.0, 0.1, 0.1), (), 1e-9, "")
    verdict = SimpleNamespace(nominal=Model(CameraProfile(640, 480), None, ()))
    (named,) = offset_as_timestamp(verdict, [finding], np.zeros(5))  # type: ignore[arg-type]
    assert [rival.name for rival in named.rivals] == ["exposure_time"]


@pytest.mark.parametrize(("beside", "rivals"), [("gyro_averaging", ["gyro_lowpass"]), ("gyro_scale", [])])
def test_an_offset_beside_a_filter_of_unknown_shape_has_the_filter_as_rival(beside: str, rivals: list[str]) -> None:
    """How much of a delay belongs to the filter depends on its shape."""
    gain = HeldOutGain(GEOMETRY, 1.0, 0.1, 0.1)
    late = Finding("time_offset", {"time_offset_s": ParameterChange(0.0, 0.004, 1e-5)}, gain, (), 1e-9, "")
    found = offset_beside_averaging([late, replace(late, name=beside)])
    assert [[rival.name for rival in finding.rivals] for finding in found] == [rivals, []]


@pytest.mark.parametrize(("shift_s", "std_s", "name"), [
    (-0.00295, 0.0001, "timestamp_reference"),
    (-0.0005, 0.0001, "time_offset"),
    (-0.0005, 0.001, "time_offset"),
    (-0.0025, 0.001, "timestamp_reference"),
])  # fmt: skip
def test_an_uncertain_offset_is_not_a_timestamp_reference(shift_s: float, std_s: float, name: str) -> None:
    """With 6 ms exposure the middle is 3 ms away; a large deviation does not make 0.5 ms compatible with it."""
    change = {"time_offset_s": ParameterChange(0.004, 0.004 + shift_s, std_s)}
    finding = Finding("time_offset", change, HeldOutGain(GEOMETRY, 1.0, 0.1, 0.1), (), 1e-9, "")
    model = Model(replace(CameraProfile(640, 480), time_offset_s=0.004), None, ())
    verdict = SimpleNamespace(nominal=model, model=model)
    (named,) = offset_as_timestamp(verdict, [finding], np.full(5, 0.006))  # type: ignore[arg-type]
    assert named.name == name
