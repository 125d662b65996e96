"""Local blur: widths of edges and ratios of spectra determine exposure time and defocus without false alarms."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import erf

from virest.app.simulate import simulate_command
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.profile_file import read_profile
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.capture.folder import read_capture
from virest.capture.imu import ImuSamples
from virest.capture.records import Frame
from virest.capture.video import GrayReader, probe_movie
from virest.diagnosis import local_blur
from virest.diagnosis.edge_overshoot import judge_sharpening
from virest.diagnosis.local_blur import (
    BlurObservations,
    frames_to_read,
    look_for_blur,
    look_for_steps,
    residuals,
)
from virest.diagnosis.local_blur_edges import (
    EdgeWidths,
    evenly_isolated,
    fit_steps,
    isolated_edges,
    measure_widths,
    observe_picture,
    share_a_reach,
)
from virest.diagnosis.local_blur_fit import EDGE_STD, Defocus, ExposureTime, fit, held_out
from virest.diagnosis.local_blur_model import fitted_width, node_tensors
from virest.image_formation.kernels import kernel_field
from virest.image_formation.row_motion import row_motion
from virest.inference.edges import EdgeSettings, find_edges
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import Trajectory

Observed = tuple[BlurObservations, CameraProfile, Trajectory]
BOTH = (ExposureTime(), Defocus())


def observed(folder: Path, seed: int, *effects: str, bits_per_px: float = 0.5) -> Observed:
    """A short simulated capture's blur observations, nominal profile and trajectory."""
    simulate_command(
        folder, width=448, height=336, frames=42, exposure_ms=[13.0, 8.0, 10.0], rate_rad_s=1.3, seed=seed,
        bitrate_bits_per_px=bits_per_px, effects=effects, truth_frames=False,
    )  # fmt: skip
    capture = read_capture(folder, look_at_pictures=False)
    profile = read_profile(folder / "camera.yaml")
    trajectory = integrate_gyro(capture.imu, profile)
    gray = GrayReader(capture.movie, probe_movie(capture.movie))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(local_blur, "frames_to_read", partial(frames_to_read, pairs=11))
        return look_for_blur(gray, capture, profile, trajectory), profile, trajectory


@pytest.fixture(scope="module")
def nominal_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the capture with nothing hidden."""
    return tmp_path_factory.mktemp("null") / "trip"


@pytest.fixture(scope="module")
def nominal(nominal_folder: Path) -> Observed:
    """A capture with nothing hidden."""
    return observed(nominal_folder, 51)


@pytest.fixture(scope="module")
def altered(tmp_path_factory: pytest.TempPathFactory) -> Observed:
    """A capture exposed 1.5 times as long as logged, and defocused by 1.3 px."""
    return observed(tmp_path_factory.mktemp("both") / "trip", 52, "exposure_time=1.5", "defocus=1.3")


@pytest.mark.parametrize("direction", ["bottom_to_top", "left_to_right"])
def test_blur_path_covariances_match_the_kernels(direction: str) -> None:
    """Covariances computed for all frames at once equal those of restoration's kernels, with a moving lens."""
    lens = Intrinsics(320, 240, 261.0, 255.0, 151.0, 128.0, "radtan", (-0.06, 0.01, 0.001, -0.002, 0.0))
    extensions = Extensions(focal_drift_per_s=0.02, stabilisation_fraction=0.4, stabilisation_cutoff_hz=0.7)
    shutter = Shutter(0.023, direction, exposure_scale=1.2)
    profile = CameraProfile(320, 240, intrinsics=lens, shutter=shutter, time_offset_s=0.013, extensions=extensions)
    time_s = np.arange(0.0, 1.5, 0.005)
    rate = np.stack([1.1 * np.sin(6 * time_s), 1.4 * np.cos(5 * time_s), 2.0 * np.sin(8 * time_s + 1)], axis=-1)
    trajectory = integrate_gyro(ImuSamples(time_s, rate, np.full_like(rate, np.nan)), profile)
    points = np.array([[30.0, 200.0], [290.0, 25.0], [160.0, 130.0], [75.0, 60.0]])
    stamp_s, exposure_s = np.array([0.3, 1.1, 0.7]), np.array([0.012, 0.02, 0.005])
    found = node_tensors(points, stamp_s, exposure_s, profile, trajectory)
    for k, stamp in enumerate(stamp_s):
        paths = kernel_field(row_motion(trajectory, profile, stamp, exposure_s[k]), points).paths_px
        for place, path in enumerate(paths):
            xx, xy, _, yy = np.cov(path.T, ddof=0).ravel() / (1 - 1 / len(path) ** 2)
            np.testing.assert_allclose(found[k, place], [xx, xy, yy], atol=3e-3 * (xx + yy))


def test_measuring_in_parts_gives_the_same_observations(
    nominal: Observed, nominal_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Edges and spectra measured in parts equal those of one pass."""
    monkeypatch.setattr(local_blur, "frames_to_read", lambda capture: [3, 5, 7, 8, 9, 12])
    capture, (_, profile, trajectory) = read_capture(nominal_folder, look_at_pictures=False), nominal
    gray = GrayReader(capture.movie, probe_movie(capture.movie))
    parts = look_for_blur(gray, capture, profile, trajectory)
    monkeypatch.setattr(local_blur, "PARTS", 1)
    whole = look_for_blur(gray, capture, profile, trajectory)
    np.testing.assert_array_equal(parts.edges.width_px, whole.edges.width_px)
    np.testing.assert_array_equal(parts.ratios.log_ratio, whole.ratios.log_ratio)
    assert parts.edges.candidates == whole.edges.candidates
    assert len(whole.ratios) > 0


def test_blur_returns_the_edge_profiles_of_sharpening(
    nominal: Observed, nominal_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames shared by two parts count once, and sharpening is judged without reading a frame again."""
    monkeypatch.setattr(local_blur, "frames_to_read", lambda capture: [3, 5, 7, 8, 9, 12])
    capture, (_, profile, trajectory) = read_capture(nominal_folder, look_at_pictures=False), nominal
    gray = GrayReader(capture.movie, probe_movie(capture.movie))
    seen, own = look_for_blur(gray, capture, profile, trajectory).steps, look_for_steps(gray, capture)
    assert seen is not None
    assert len(np.unique(own.stamp_s)) == 6
    for name in ("profile", "points_px", "normal", "stamp_s", "exposure_s"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(own, name))

    def unread(_frames: object) -> Iterator[tuple[int, None]]:
        raise AssertionError

    by_blur = judge_sharpening(capture, profile, trajectory, unread, steps=seen)
    assert by_blur.findings == judge_sharpening(capture, profile, trajectory, gray).findings


def test_the_width_of_a_blurred_step_is_found(rng: np.random.Generator) -> None:
    """The width of a step of 0.8 px to 3 px, off centre and at any level, is found within 1 %."""
    u = np.arange(-14, 14.01, 0.5)
    width, centre = rng.uniform(0.8, 3.0, 40), rng.uniform(-0.6, 0.6, 40)
    steps = 0.3 + 0.2 * erf((u - centre[:, None]) / (np.sqrt(2) * width[:, None]))
    found_centre, found, _ = fit_steps(steps, 14.0)
    np.testing.assert_allclose(found, width, rtol=0.01)
    np.testing.assert_allclose(found_centre, centre, atol=0.01)


def test_lines_and_waves_are_not_steps() -> None:
    """A thin line and a sine have slopes as strong as a step's but no width."""
    u = np.arange(-19, 19.01, 0.5)
    line = np.exp(-0.5 * (u / 1.5) ** 2)
    wave = np.sin(2 * np.pi * u / 9)
    step = erf(u / (np.sqrt(2) * 1.7))
    found = measure_widths(np.stack([line, wave, step]))
    steps = found.width_px > 0
    assert set(found.row[steps]) == {2}
    np.testing.assert_allclose(found.width_px[steps], 1.7, rtol=0.01)


def crowded(rng: np.random.Generator, width_px: float) -> EdgeWidths:
    """Measured widths of steps whose widths scatter by 15 %, each with another step at some distance."""
    u, beside = np.arange(-19, 19.01, 0.5), 8.0 + 6.0 * rng.exponential(1.0, 3000)
    own = width_px * np.exp(rng.normal(0, 0.15, 3000))[:, None]
    steps = erf(u / (np.sqrt(2) * own)) - 0.7 * erf((u - beside[:, None]) / (np.sqrt(2) * own))
    fit = measure_widths(steps + rng.normal(0, 0.004, steps.shape))
    one, two = np.ones(len(fit.row)), np.zeros((len(fit.row), 2))
    return EdgeWidths(
        np.zeros(len(one), np.intp), one, one, two, two, fit.row, fit.reach_px, fit.width_px, one, one, len(steps)
    )


@pytest.mark.parametrize("width_px", [2.1, 2.6, 3.1])
def test_crowded_edges_are_not_measured_too_narrow(rng: np.random.Generator, width_px: float) -> None:
    """Selecting edges isolated over their own width favours narrow ones by more than 3 %."""
    seen = crowded(rng, width_px)
    own, even = isolated_edges(seen).width_px, evenly_isolated(seen, 40).width_px
    assert np.median(own) < 0.968 * width_px
    assert len(even) >= 40
    assert np.median(even) == pytest.approx(width_px, rel=0.03)


def test_too_few_evenly_isolated_edges_use_their_own_reach(rng: np.random.Generator) -> None:
    """Few edges with a common reach carry less information than more edges with their own."""
    seen = crowded(rng, 3.1)
    own = isolated_edges(seen)
    np.testing.assert_array_equal(evenly_isolated(seen, len(own)).width_px, own.width_px)
    assert not share_a_reach(own)
    assert share_a_reach(evenly_isolated(seen, 40))


def test_widths_add_in_quadrature_up_to_the_shape_of_a_path() -> None:
    """Without motion the width is the Gaussian's; a long path gives a ramp, to which a wider Gaussian is fitted."""
    u, path = np.arange(-12, 12.01, 0.5), np.sqrt(12) * 3.0 * (np.arange(400) / 399 - 0.5)
    ramp = erf((u[:, None] - path) / (np.sqrt(2) * 0.5)).mean(axis=1)
    assert fitted_width(np.array([0.0]), 1.2, 0.5)[0] == pytest.approx(1.3, rel=1e-3)
    assert fitted_width(np.array([3.0]), 0.0, 0.5)[0] == pytest.approx(fit_steps(ramp[None], 12.0)[1][0], rel=0.03)


def test_an_exposure_at_the_end_of_its_range_is_undetermined(nominal: Observed) -> None:
    """Frames without the predicted blur would require a zero exposure; the value stays undetermined."""
    observations, profile, trajectory = nominal
    none_seen = replace(observations.ratios, log_ratio=0.0 * observations.ratios.log_ratio)
    found = fit(replace(observations, ratios=none_seen), profile, trajectory, BOTH)
    assert found.determined == (False, True)
    assert np.isinf(found.std[0])
    assert found.profile.shutter.exposure_scale == profile.shutter.exposure_scale


def test_a_nominal_capture_stays_nominal(nominal: Observed) -> None:
    """Neither effect is significant, although both are determined."""
    found = fit(*nominal, BOTH)
    scale, sigma = found.values[0][0], found.values[1][0]
    assert found.determined == (True, True)
    assert abs(scale - 1.0) < 3 * found.std[0]
    assert found.std[0] < 0.15
    assert sigma < 3 * found.std[1]


def test_exposure_and_defocus_are_found_together(altered: Observed) -> None:
    """Both lie within three deviations and 12 % of the truth, and improve held-out time blocks."""
    found = fit(*altered, BOTH)
    for value, truth, std in zip(np.concatenate(found.values), (1.5, 1.3), found.std, strict=True):
        assert abs(value - truth) < 3 * std
        assert value == pytest.approx(truth, rel=0.12)
    assert found.profile.shutter.exposure_scale == found.values[0][0]
    assert found.profile.extensions.defocus_sigma_px == found.values[1][0]
    of_exposure, of_defocus = held_out(*altered, BOTH)
    assert of_exposure.after < 0.95 * of_exposure.before
    assert of_defocus.after < 0.4 * of_defocus.before


def test_a_deviation_includes_a_common_error_of_all_widths(altered: Observed) -> None:
    """The selection of isolated edges depends on their apparent width, so all widths may be slightly too large."""
    observations, *rest = altered
    wider = replace(observations.edges, width_px=(1 + EDGE_STD) * observations.edges.width_px)
    one, other = fit(observations, *rest, BOTH), fit(replace(observations, edges=wider), *rest, BOTH)
    assert 0 < other.values[1][0] - one.values[1][0] < one.std[1]


def test_widths_that_scatter_are_no_defocus(nominal: Observed, rng: np.random.Generator) -> None:
    """A coder that lacks bits widens edges, each by another amount; a defocus widens all alike."""
    observations, *rest = nominal
    deviations = {}
    for scatter in (0.05, 0.4):
        widths = 1.3 * np.exp(rng.normal(0, scatter, len(observations.edges)))
        wider = replace(observations, edges=replace(observations.edges, width_px=widths))
        found = fit(wider, *rest, [Defocus()])
        assert found.values[0][0] == pytest.approx(1.0, abs=0.2)
        deviations[scatter] = found.values[0][0] / found.std[0]
    assert deviations[0.05] > 6
    assert deviations[0.4] < 3


def test_the_profile_alone_describes_the_effects(altered: Observed) -> None:
    """Without any fit, the true profile has smaller residuals than the nominal one."""
    observations, profile, trajectory = altered
    true = Defocus().apply(ExposureTime().apply(profile, np.array([1.5])), np.array([1.3]))
    plain, right = (residuals(observations, p, trajectory) for p in (profile, true))
    edge = observations.is_edge
    assert len(plain) == len(observations)
    assert np.median(np.abs(right[edge])) < 0.4 * np.median(np.abs(plain[edge]))
    assert np.median(np.abs(right[~edge])) < np.median(np.abs(plain[~edge]))


def test_a_smooth_scene_is_not_reported_as_defocused(rng: np.random.Generator, altered: Observed) -> None:
    """Smooth texture has few isolated steps, so the defocus stays undetermined."""
    texture = cv2.GaussianBlur(rng.normal(size=(336, 448)), (0, 0), 3.0)
    picture = np.clip(120 + 45 * texture / texture.std(), 1, 250).astype(np.uint8)
    frame = Frame(0, 0, 0.0, 0.01)
    edges = isolated_edges(observe_picture(picture, frame, ResponseCurve("srgb"), *find_edges(picture, EdgeSettings())))
    observations, profile, trajectory = altered
    smooth = replace(observations, edges=edges, isolated=len(edges))
    assert edges.candidates > 100
    found = fit(smooth, profile, trajectory, [Defocus()])
    assert found.determined == (False,)
    assert np.isnan(found.values[0]).all()
    assert np.isinf(found.std).all()


def test_a_low_bit_rate_does_not_shorten_the_exposure(nominal: Observed, tmp_path: Path) -> None:
    """Few bits make spectra more similar, as shorter exposures do; the fit reports a larger deviation."""
    starved = observed(tmp_path / "trip", 51, bits_per_px=0.1)
    assert starved[0].bits_per_px == pytest.approx(0.1, rel=0.2)
    found, rich = fit(*starved, (ExposureTime(),)), fit(*nominal, (ExposureTime(),))
    assert abs(found.values[0][0] - 1) < 2.5 * found.std[0]
    assert found.std[0] > 2 * rich.std[0]
    as_if_rich = replace(starved[0], bits_per_px=np.inf)
    assert fit(as_if_rich, *starved[1:], (ExposureTime(),)).values[0][0] < 0.85
