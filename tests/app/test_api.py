"""``import virest``: opening captures, restoring and deblurring arrays, and the commands' records."""

import inspect
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import cv2
import numpy as np
import pytest

import virest
from virest.app.api_records import CalibratedFacts, CalibrationFacts, SimulationFacts, SimulationOptions
from virest.app.simulate import simulate_command
from virest.camera.response import ResponseCurve
from virest.errors import CalibrationError, CaptureError, ImuError, SettingsError
from virest.simulation.phone_isp import make_isp

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "leaves"
FRAME = 5


def psnr_db(first: np.ndarray, second: np.ndarray, border: int = 40) -> float:
    """PSNR between two pictures, without their borders."""
    inner = np.s_[border:-border, border:-border]
    error = first[inner].astype(float) - second[inner].astype(float)
    return float(10 * np.log10(255**2 / np.mean(error**2)))


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """The sharp frame of the sample capture."""
    picture = cv2.imread(str(SAMPLE / "truth" / "frames" / f"{FRAME:06d}.png"))
    assert picture is not None
    return np.ascontiguousarray(picture[..., ::-1])


def test_importing_virest_loads_no_heavy_library() -> None:
    """Importing the package loads only the package. The first function that needs numpy or OpenCV loads it."""
    code = "import sys, virest; print([m for m in ('numpy', 'cv2', 'scipy', 'pandas', 'pydantic') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_name_in_all_exists() -> None:
    """Every name in ``__all__`` is available; any other name raises AttributeError."""
    assert all(getattr(virest, name) is not None for name in virest.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = virest.nothing


def test_one_call_restores_a_frame(truth: np.ndarray) -> None:
    """The restored picture is at least 3 dB closer to the truth than the recorded frame."""
    capture = virest.open(SAMPLE)
    recorded, stamp = capture.read_frame(FRAME), capture.frames[FRAME]
    restored = virest.restore(
        recorded, capture.imu, capture.profile, time_s=stamp.time_s, exposure_s=stamp.exposure_s, preset="fast"
    )
    assert restored.status == "restored"
    assert restored.picture is not None
    assert psnr_db(restored.picture, truth) > psnr_db(recorded, truth) + 3.0
    again = capture.restore(FRAME, preset="fast").picture
    assert again is not None
    assert psnr_db(again, truth) > psnr_db(recorded, truth) + 3.0


def test_a_grey_frame_stays_grey() -> None:
    """A frame of shape (height, width) is restored to the same shape."""
    capture = virest.open(SAMPLE)
    grey = cv2.cvtColor(capture.read_frame(FRAME), cv2.COLOR_RGB2GRAY)
    stamp = capture.frames[FRAME]
    restored = virest.restore(grey, capture.imu, capture.profile, time_s=stamp.time_s, exposure_s=None, preset="fast")
    assert restored.picture is not None
    assert restored.picture.shape == grey.shape


def _blurred(sharp: np.ndarray, kernel: np.ndarray, curve: ResponseCurve, rng: np.random.Generator) -> np.ndarray:
    """The picture convolved in linear light, with noise, independently of the package's kernels."""
    light = curve.linear_table()[sharp]
    turned = kernel[::-1, ::-1] / kernel.sum()
    light = cv2.filter2D(light, -1, turned, anchor=(kernel.shape[1] // 2, kernel.shape[0] // 2))
    grey = 255 * curve.encode(light) + rng.normal(0, 1.5, light.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("colour", [True, False])
def test_deblurring_with_a_kernel_does_not_shift_the_picture(truth: np.ndarray, colour: bool) -> None:
    """A picture blurred by an asymmetric kernel is restored at its original position."""
    sharp = truth[300:700, 100:620] if colour else cv2.cvtColor(truth[300:700, 100:620], cv2.COLOR_RGB2GRAY)
    kernel = np.zeros((15, 19))
    kernel[7, 9:18] = 1.0
    kernel[7:13, 17] += 2.0
    recorded = _blurred(sharp, kernel, ResponseCurve("srgb"), np.random.default_rng(3))
    restored = virest.deblur(recorded, kernel)
    assert restored.shape == recorded.shape
    assert psnr_db(restored, sharp) > psnr_db(recorded, sharp) + 4.0


def test_deblurring_with_a_path_does_not_shift_the_picture(truth: np.ndarray) -> None:
    """A picture blurred along a path is restored as it was at the start of the path."""
    sharp = truth[300:700, 100:620]
    kernel = np.zeros((19, 19))
    kernel[9, 9:19] = 1.0
    recorded = _blurred(sharp, kernel, ResponseCurve("gamma", gamma=2.2), np.random.default_rng(4))
    restored = virest.deblur(recorded, path_px=np.array([[-0.5, 0.0], [9.5, 0.0]]), response="gamma:2.2")
    assert psnr_db(restored, sharp) > psnr_db(recorded, sharp) + 4.0


def test_invalid_arguments_raise_errors_with_a_hint() -> None:
    """Invalid sizes, types and names raise a one-line error instead of a traceback from numpy."""
    capture = virest.open(SAMPLE)
    with pytest.raises(SettingsError, match="uint8"):
        virest.deblur(np.zeros((64, 64)), np.ones((3, 3)))
    with pytest.raises(SettingsError, match="too small"):
        virest.deblur(np.zeros((40, 40), np.uint8), np.ones((1, 9)))
    with pytest.raises(SettingsError, match="needs a kernel or path_px"):
        virest.deblur(np.zeros((64, 64), np.uint8))
    with pytest.raises(SettingsError, match="the profile 720x1280"):
        virest.restore(np.zeros((8, 8), np.uint8), capture.imu, capture.profile, time_s=0, exposure_s=0.01)
    with pytest.raises(SettingsError, match="unknown setting 'shuter'"):
        capture.restore(0, shuter="none")
    with pytest.raises(CaptureError, match="no frame 99"):
        capture.read_frame(99)
    for nothing, kernel in ((np.zeros((0, 64), np.uint8), np.ones((1, 9))), (np.zeros((64, 64), np.uint8), [[]])):
        with pytest.raises(SettingsError):
            virest.deblur(nothing, np.array(kernel))
    with pytest.raises(SettingsError, match=r"settings: deblur: .*'nope'"):
        capture.restore(0, deblur="nope")
    with pytest.raises(SettingsError, match="the profile: image 64x48"):
        virest.open(SAMPLE, virest.CameraProfile(64, 48))


def test_numbers_that_cannot_be_are_refused_by_restore() -> None:
    """They came out as errors of numpy, or, of samples in the wrong order, as a wrong picture."""
    capture = virest.open(SAMPLE)
    imu, picture = capture.imu, np.zeros((1280, 720), np.uint8)

    def restore(imu: virest.ImuSamples, time_s: float = 0.0, exposure_s: float = 0.01) -> None:
        virest.restore(picture, imu, capture.profile, time_s=time_s, exposure_s=exposure_s)

    for times in ((np.nan, 0.01), (0.0, np.nan), (0.0, -1.0), (0.0, 1e9)):
        with pytest.raises(SettingsError, match=r"time_s is nan|exposure_s is"):
            restore(imu, *times)
    wrong = {
        "of shapes": virest.ImuSamples(imu.time_s, imu.gyro_rad_s[:5], imu.accel_m_s2),
        "not finite": virest.ImuSamples(imu.time_s, imu.gyro_rad_s * np.nan, imu.accel_m_s2),
        "do not rise at row 1": virest.ImuSamples(imu.time_s[::-1], imu.gyro_rad_s, imu.accel_m_s2),
    }
    for says, samples in wrong.items():
        with pytest.raises(ImuError, match=says):
            restore(samples)


def test_settings_given_by_name_hold() -> None:
    """The number of neighbours no longer sets aside a given limit; numpy's numbers count as numbers."""
    from virest.app.api import _settings

    assert _settings("balanced", {"neighbours": np.int64(3), "most_joined": 2}).most_joined == 2
    assert _settings("balanced", {"neighbours": 3}).most_joined == 6


def test_calibrate_returns_the_record_and_writes_only_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``virest.calibrate`` returns what ``--json`` prints; without ``out`` it writes nothing."""
    monkeypatch.chdir(tmp_path)
    simulated = virest.simulate(
        "walk", width=256, height=192, frames=18, seed=2, rate_rad_s=1.5, exposure_ms=6.0, effects=["time_offset=0.02"]
    )
    assert simulated["frames"] == 18
    optional = {"auto_exposure_ev", "exposure_range_ms", "iso_range", "isp"}
    assert set(simulated) == set(SimulationFacts.__annotations__) - optional
    before = sorted(tmp_path.rglob("*"))
    found = virest.calibrate("walk")
    assert set(found) == set(get_type_hints(CalibrationFacts)) - {"written"}
    assert set(found["values"][0]) == set(CalibratedFacts.__annotations__)
    offset = next(value for value in found["values"] if value["name"] == "time_offset_s")
    assert offset["value"] == pytest.approx(0.02, abs=5e-4)
    with pytest.raises(SettingsError, match="did you mean 'focal'"):
        virest.calibrate("walk", extra=["focl"])
    assert sorted(tmp_path.rglob("*")) == before


def test_a_capture_with_auto_exposure_and_isp_has_the_declared_facts(tmp_path: Path) -> None:
    """Auto-exposure and the phone's image processing add facts that the type declaration lists."""
    simulated = virest.simulate(
        tmp_path / "phone", width=128, height=96, frames=3, auto_exposure_ev=2.0, isp=make_isp("phone")
    )
    assert set(simulated) == set(SimulationFacts.__annotations__)


def test_calibrating_a_camera_at_rest_is_an_error(tmp_path: Path) -> None:
    """A camera at rest determines no value."""
    virest.simulate(tmp_path / "rest", width=320, height=240, frames=8, rate_rad_s=0.0)
    with pytest.raises(CalibrationError):
        virest.calibrate(tmp_path / "rest")


def test_the_typed_options_are_those_of_the_simulator() -> None:
    """The type declaration lists exactly the keywords that ``simulate`` takes, with their types."""
    taken = {
        name: parameter.annotation
        for name, parameter in inspect.signature(simulate_command).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY
    }
    assert {name: kind.__forward_arg__ for name, kind in SimulationOptions.__annotations__.items()} == taken
