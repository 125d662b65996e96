"""The table of effects: each effect has one entry here and nowhere else.

To add an effect, add it here, to the forward model (``image_formation`` or ``motion``) and, from its definition, to the
simulator.  Effects on points are fitted by the steps given here, effects on light by the estimators of their evidence.

A phone's denoiser is not listed: at 0.15 to 0.3 bit per pixel the encoder removes more noise in flat regions than a
strong denoiser does, and the amount depends more on the encoder than on the denoiser.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from virest.arrays import Array
from virest.camera.gyro_filter import delay_s
from virest.camera.profile import CameraProfile
from virest.camera.shutter import READOUT_DIRECTIONS, STAMP_FRACTION
from virest.effects import changes as by
from virest.effects.records import BLUR, EDGES, GEOMETRY, PHOTOMETRY, Calibrated, Choice, Effect, Parameter, Steps

INF = float("inf")
Read = Callable[[CameraProfile], Any]


def _own(value: Any, std: Array) -> float:
    return float(std[0])


def _relative(value: Any, std: Array) -> float:
    """Deviation of a value whose step is a logarithm."""
    return float(std[0]) * abs(float(value))


def _each(value: Any, std: Array) -> list[float]:
    return [float(s) for s in std]


def _second_relative(value: Any, std: Array) -> float:
    return float(std[1]) * abs(float(value))


def _of_axes(value: Any, std: Array) -> list[float]:
    """Deviations of three relative scales: two are steps, and the third balances them, as if these were independent."""
    steps = (*std[:2], float(np.hypot(*std[:2])))
    return [float(s) * abs(float(v)) for s, v in zip(steps, value, strict=True)]


def _of_misalignment(value: Any, std: Array) -> list[float]:
    return [float(s) for s in std[2:]]


def _of_cutoff(value: Any, std: Array) -> float:
    """The step is the delay τ of a cutoff √2 / (2π τ), whose relative deviation is the same."""
    return float(std[0]) * abs(float(value)) / max(delay_s(value), 1e-9)


def _of_travel(value: Any, std: Array) -> float | None:
    """The step is the inverse of the travel."""
    return None if value is None else float(std[4]) * float(value) ** 2


def _of_root(value: Any, std: Array) -> float:
    """Deviation of a value whose step is its square; near 0 that of the square decides."""
    return float(std[0]) / max(2 * abs(float(value)), float(np.sqrt(std[0])), 1e-12)


def _none(value: Any, std: Array) -> None:
    """No deviation from steps: the estimator reports it."""


def _value(name: str, read: Read, spread: Callable[[Any, Array], Any] = _own) -> tuple[Parameter, ...]:
    return (Parameter(name, lambda profile, given: read(profile), spread),)


def _difference(read: Read) -> Callable[[CameraProfile, CameraProfile], Array]:
    return lambda before, after: np.atleast_1d(np.subtract(read(after), read(before)))


def _log_ratio(read: Read) -> Callable[[CameraProfile, CameraProfile], Array]:
    return lambda before, after: np.array([np.log(read(after) / read(before))])


def _focal(profile: CameraProfile) -> float:
    return 1.0 if profile.intrinsics is None else profile.intrinsics.fx_px


def _curve(name: str, without: float) -> Read:
    return lambda profile: without if profile.response is None else getattr(profile.response, name)


def _extension(name: str) -> Read:
    return lambda profile: getattr(profile.extensions, name)


def _estimated(name: str) -> Read:
    """A value that only the estimates record; 0 without one."""

    def read(profile: CameraProfile) -> float:
        known = profile.estimates.get(name)
        return known.value if known is not None and isinstance(known.value, float) else 0.0

    return read


def _applied(size: str, text: str) -> Callable[[CameraProfile], str]:
    """A line for the log where the extension ``size`` is on; {} is filled with the extensions."""
    return lambda profile: text.format(e=profile.extensions) if getattr(profile.extensions, size) else ""


def _applied_axes(profile: CameraProfile) -> str:
    turned = profile.extensions.gyro_misalignment_rad
    return f"gyroscope's misalignment of {', '.join(f'{t:g}' for t in turned)} rad: corrected" if any(turned) else ""


GYRO_SCALE_OFF = 0.15
"""Five times the 3 % sensitivity tolerance of phone gyroscopes (BMI160, LSM6DSO, ICM-20602): beyond it is a fault."""
STABILISED_OFF = 1.1
"""Fraction of the shake that a stabiliser cancels: all of it, and a tenth for a gyroscope or lens of another scale."""
ANOTHER_LENS = 1.2
"""Logarithm of the focal ratio: a phone's other lenses have 0.5 to 3 times the focal length of the main one."""
SENSOR_TURNED = 3.2
"""Radians: a sensor may be mounted in any orientation, and drivers swap and flip its axes."""
CLOCK_SKEW_OFF = 0.02
"""Above any real skew: crystals agree to 1e-4, and recorders that write another clock's rate are off by 0.5 %."""

_POINTS = (
    Effect(
        "time_offset",
        GEOMETRY,
        _value("time_offset_s", lambda p: p.time_offset_s),
        "imu.time_offset_s",
        "camera and IMU clocks differ by an offset",
        "the IMU clock is offset from the camera clock by {time_offset_s} s",
        Steps(
            by.shift_offset,
            _difference(lambda p: p.time_offset_s or 0.0),
            (1e-4,),
            (0.02,),
            (INF,),
            2.0,
            tuple((0.02 * k,) for k in (-3, -2, -1, 1, 2, 3)),
        ),
        calibrated=Calibrated("time_offset_s", lambda p: p.time_offset_s, lambda p, given: p, 0.002),
    ),
    Effect(
        "clock_skew",
        GEOMETRY,
        _value("clock_skew", lambda p: p.clock_skew),
        "imu.clock_skew",
        "camera and IMU clocks run at different rates",
        "the camera and IMU clocks drift apart by {clock_skew} s per second",
        Steps(
            by.skew_clock, _difference(lambda p: p.clock_skew), (1e-4,), (0.005,), (0.05,), 0.03, ((-0.003,), (0.003,))
        ),
        calibrated=Calibrated(
            "clock_skew", lambda p: p.clock_skew, by.keep_value("clock_skew"), 0.0015, "clock-skew", CLOCK_SKEW_OFF
        ),
    ),
    Effect(
        "readout_time",
        GEOMETRY,
        _value("readout_time_s", lambda p: p.shutter.readout_time_s),
        "shutter.readout_time_s",
        "the readout time differs from the profile's",
        "the readout takes {readout_time_s} s",
        Steps(
            by.lengthen_readout,
            _difference(lambda p: p.shutter.readout_time_s),
            (2e-4,),
            (0.01,),
            (INF,),
            0.06,
            ((0.008,), (-0.008,)),
        ),
        calibrated=Calibrated(
            "readout_time_s", lambda p: p.shutter.readout_time_s if p.readout_known else None, by.keep_readout, 0.002
        ),
    ),
    Effect(
        "readout_direction",
        GEOMETRY,
        _value("readout_direction", lambda p: p.shutter.readout_direction, _none),
        "shutter.readout_direction",
        "the readout direction differs from the profile's",
        "the sensor is read {readout_direction}",
        choice=Choice(READOUT_DIRECTIONS, lambda p, word: p.with_shutter(readout_direction=word)),
    ),
    Effect(
        "timestamp_reference",
        GEOMETRY,
        _value("timestamp", lambda p: p.shutter.timestamp, _none),
        "shutter.timestamp",
        "the frame timestamps mark another instant of the exposure",
        "a frame's timestamp marks its {timestamp}",
        choice=Choice(tuple(STAMP_FRACTION), lambda p, word: p.with_shutter(timestamp=word)),
    ),
    Effect(
        "exposure_time",
        BLUR,
        _value("exposure_scale", lambda p: p.shutter.exposure_scale, _relative),
        "shutter.exposure_scale",
        "the exposure is longer or shorter than logged",
        "the true exposure is {exposure_scale} times the logged one",
        Steps(by.scale_exposure, _log_ratio(lambda p: p.shutter.exposure_scale), (0.05,), (0.3,), (0.7,), 1.5),
        calibrated=Calibrated(
            "exposure_scale",
            lambda p: p.shutter.exposure_scale,
            lambda p, given: p.with_shutter(exposure_scale=given.shutter.exposure_scale),
            0.25,
            "exposure-scale",
            1.0,
            True,
        ),
    ),
    Effect(
        "gyro_bias",
        GEOMETRY,
        _value("gyro_bias_rad_s", lambda p: list(p.gyro_bias_rad_s), _each),
        "imu.gyro_bias_rad_s",
        "the gyroscope has a bias",
        "the gyroscope reads {gyro_bias_rad_s} rad/s at rest",
        Steps(by.add_bias, _difference(lambda p: p.gyro_bias_rad_s), (1e-3,) * 3, (0.05,) * 3, (0.1,) * 3, 0.5),
        calibrated=Calibrated(
            "gyro_bias_rad_s", lambda p: list(p.gyro_bias_rad_s), by.keep_value("gyro_bias_rad_s"), 0.006
        ),
    ),
    Effect(
        "gyro_scale",
        GEOMETRY,
        _value("gyro_scale", by.mean_gyro_scale, _relative),
        "imu.gyro_scale",
        "the gyroscope's scale is off",
        "the gyroscope's rates are {gyro_scale} times the true ones",
        Steps(by.scale_gyro, _log_ratio(by.mean_gyro_scale), (1e-3,), (0.1,), (0.3,), 0.4),
        calibrated=Calibrated(
            "gyro_scale",
            by.mean_gyro_scale,
            by.keep_value("gyro_scale"),
            0.02,
            "gyro-scale",
            GYRO_SCALE_OFF,
            True,
        ),
    ),
    Effect(
        "gyro_axes",
        GEOMETRY,
        (
            Parameter("axis_scale", lambda p, given: by.axis_scale(p).tolist(), _of_axes),
            Parameter("misalignment_rad", lambda p, given: list(p.extensions.gyro_misalignment_rad), _of_misalignment),
        ),
        "imu.gyro_scale, extensions.gyro_misalignment_rad",
        "the gyroscope's axes differ in scale or are not perpendicular",
        "the gyroscope's axes read {axis_scale} times their mean, and {misalignment_rad} of each other (xy, xz, yz)",
        Steps(
            by.skew_gyro_axes,
            by.gyro_axes_between,
            (1e-3,) * 5,
            (0.1,) * 5,
            (0.1,) * 5,
            GYRO_SCALE_OFF,
        ),
        applied=_applied_axes,
    ),
    Effect(
        "gyro_lowpass",
        GEOMETRY,
        _value("gyro_lowpass_hz", _extension("gyro_lowpass_hz"), _of_cutoff),
        "extensions.gyro_lowpass_hz",
        "the gyroscope low-pass filters its rates: they are late, fast ones also too small",
        "the gyroscope low-pass filters its rates at {gyro_lowpass_hz} Hz: they are late, fast ones also too small",
        Steps(
            by.delay_gyro,
            _difference(lambda p: delay_s(p.extensions.gyro_lowpass_hz)),
            (1e-4,),
            (0.01,),
            (INF,),
            0.1,
            ((0.006,), (0.02,)),
        ),
        applied=_applied("gyro_lowpass_hz", "gyroscope's low-pass filter of {e.gyro_lowpass_hz:g} Hz: undone"),
    ),
    Effect(
        "gyro_averaging",
        GEOMETRY,
        _value("gyro_averaging_s", _extension("gyro_averaging_s"), _of_root),
        "extensions.gyro_averaging_s",
        "the gyroscope averages its rates over time: fast rotations read too small",
        "the gyroscope averages its rates over {gyro_averaging_s} s (standard deviation): fast ones read too small",
        Steps(
            by.average_gyro,
            _difference(lambda p: p.extensions.gyro_averaging_s**2),
            (1e-6,),
            (2e-4,),
            (INF,),
            0.05**2,
            ((1e-4,),),
        ),
        applied=_applied("gyro_averaging_s", "gyroscope's averaging over {e.gyro_averaging_s:g} s: undone"),
    ),
    Effect(
        "imu_rotation",
        GEOMETRY,
        (Parameter("rotation_rad", lambda p, given: by.rotation_between(given, p).tolist(), _each),),
        "imu.T_cam_imu",
        "the rotation between IMU and camera differs from the profile's",
        "the IMU-to-camera rotation is off by {rotation_rad} rad",
        Steps(by.rotate_imu, by.rotation_between, (1e-3,) * 3, (0.1,) * 3, (INF,) * 3, SENSOR_TURNED),
        calibrated=Calibrated("rotation_rad", lambda p: None, by.keep_value("r_cam_imu"), 0.01),
    ),
    Effect(
        "focal_length",
        GEOMETRY,
        (Parameter("focal_scale", lambda p, given: _focal(p) / _focal(given), _relative),),
        "intrinsics.fx_px, fy_px",
        "the focal length differs from the profile's",
        "the focal length is {focal_scale} times the profile's",
        Steps(by.scale_focal, _log_ratio(_focal), (1e-3,), (0.1,), (0.5,), ANOTHER_LENS),
        calibrated=Calibrated(
            "fx_px",
            lambda p: p.intrinsics.fx_px if p.intrinsics else None,
            by.keep_lens("fx_px", "fy_px"),
            0.02,
            "focal",
            0.2,
            True,
        ),
    ),
    Effect(
        "pixel_aspect",
        GEOMETRY,
        _value("pixel_aspect", by.pixel_aspect, _relative),
        "intrinsics.fy_px",
        "pixels are not square",
        "pixels are not square: fy is {pixel_aspect} times fx",
        Steps(by.stretch_pixels, _log_ratio(by.pixel_aspect), (1e-3,), (0.1,), (0.5,), 0.3),
    ),
    Effect(
        "focal_drift",
        GEOMETRY,
        _value("focal_drift_per_s", _extension("focal_drift_per_s")),
        "extensions.focal_drift",
        "the focal length changes while filming",
        "the focal length changes by a fraction of {focal_drift_per_s} per second (refocusing)",
        Steps(by.drift_focal, _difference(_extension("focal_drift_per_s")), (1e-3,), (0.03,), (0.2,), 0.3),
        applied=_applied("focal_drift_per_s", "focal drift of {e.focal_drift_per_s:+g} per second: followed"),
    ),
    Effect(
        "radial_distortion",
        GEOMETRY,
        _value("k1", by.k1_of),
        "intrinsics.distortion",
        "the lens bends straight lines",
        "the lens has a radial distortion of k1 = {k1}",
        Steps(by.add_k1, _difference(by.k1_of), (1e-3,), (0.1,), (0.5,), 0.8),
        calibrated=Calibrated("k1", by.k1_of, by.keep_coefficient(0), 0.03, "distortion", 0.3),
    ),
    Effect(
        "higher_distortion",
        GEOMETRY,
        _value("k2", by.k2_of),
        "intrinsics.distortion",
        "a wide lens bends straight lines less, or more, towards the corners than k1 alone does",
        "beyond k1, the lens has a radial distortion of k2 = {k2}",
        Steps(by.add_k2, _difference(by.k2_of), (1e-3,), (0.1,), (0.5,), 0.8),
        calibrated=Calibrated("k2", by.k2_of, by.keep_coefficient(1), 0.03, "higher-distortion", 0.3),
        beside="radial_distortion",
    ),
    Effect(
        "principal_point",
        GEOMETRY,
        (Parameter("offset_px", lambda p, given: by.principal_shift(given, p).tolist(), _each),),
        "intrinsics.cx_px, cy_px",
        "the principal point differs from the profile's",
        "the principal point lies {offset_px} px from the profile's",
        Steps(by.shift_principal_point, by.principal_shift, (1.0, 1.0), (20.0, 20.0), (200.0, 200.0), 300.0),
        calibrated=Calibrated(
            "principal_point_px",
            lambda p: [p.intrinsics.cx_px, p.intrinsics.cy_px] if p.intrinsics else None,
            by.keep_lens("cx_px", "cy_px"),
            12.0,
            "principal-point",
            100.0,
        ),
    ),
    Effect(
        "stabilisation",
        GEOMETRY,
        (
            *_value("fraction", _extension("stabilisation_fraction")),
            *_value("cutoff_hz", _extension("stabilisation_cutoff_hz"), _second_relative),
            *_value("travel_rad", _extension("stabilisation_travel_rad"), _of_travel),
        ),
        "extensions.stabilisation",
        "an optical stabiliser moves the lens",
        "an optical stabiliser cancels {fraction} of the motion above {cutoff_hz} Hz",
        steps=Steps(
            by.stabilise,
            by.stabilised_between,
            (0.02, 0.1, 0.01, 0.01, 0.5),
            (0.3, 0.5, 0.1, 0.1, 20.0),
            (1.0, 1.5, 0.05, 0.05, 100.0),
            STABILISED_OFF,
        ),
        addition=", up to {travel_rad} rad",
        applied=_applied(
            "stabilisation_fraction",
            "stabiliser cancelling {e.stabilisation_fraction:g} above {e.stabilisation_cutoff_hz:g} Hz: followed",
        ),
    ),
    Effect(
        "scene_depth",
        GEOMETRY,
        _value("depth_m", lambda p: p.depth_m, _none),
        "scene.depth_m",
        "the scene's distance differs from the profile's",
        "the camera translates in front of a scene {depth_m} m away, so points move by parallax",
    ),
    Effect(
        "frame_lag",
        GEOMETRY,
        (*_value("lag_s", _extension("frame_lag_s"), _none), *_value("frames", _extension("frame_lag_frames"), _none)),
        "extensions.frame_lag",
        "frames show later content than their timestamps while the recorder starts",
        "the first {frames} frames show content up to {lag_s} s later than their timestamps",
        applied=_applied(
            "frame_lag_frames",
            "recorder lag of {e.frame_lag_s:g} s: the first {e.frame_lag_frames} frames are used at their true times",
        ),
    ),
)

_LIGHT = (
    Effect(
        "response_curve",
        PHOTOMETRY,
        _value("gamma", _curve("extra_gamma", 1.0), _none),
        "extensions.response_gamma",
        "the response curve differs from the profile's",
        "the grey levels follow a gamma of {gamma} on top of the profile's curve",
    ),
    Effect(
        "black_level",
        PHOTOMETRY,
        _value("black_level", _curve("black_level", 0.0), _none),
        "extensions.black_level",
        "black is stored as grey",
        "zero light reads {black_level} of full scale",
    ),
    Effect(
        "vignetting",
        PHOTOMETRY,
        _value("corner_loss", _extension("vignetting_corner_loss"), _none),
        "extensions.vignetting",
        "the corners get less light",
        "the corners lose {corner_loss} of the light",
        applied=_applied(
            "vignetting_corner_loss", "vignetting of {e.vignetting_corner_loss:g}: kept where each pixel ends up"
        ),
    ),
    Effect(
        "flicker",
        PHOTOMETRY,
        (
            *_value("amplitude", _extension("flicker_amplitude"), _none),
            *_value("frequency_hz", _extension("flicker_frequency_hz"), _none),
            *_value("phase_rad", _extension("flicker_phase_rad"), _none),
        ),
        "extensions.flicker",
        "the lighting flickers",
        "the lighting flickers by {amplitude} at {frequency_hz} Hz",
        applied=_applied(
            "flicker_amplitude", "flicker of {e.flicker_amplitude:g} at {e.flicker_frequency_hz:g} Hz: undone"
        ),
    ),
    Effect(
        "gain_drift",
        PHOTOMETRY,
        _value("gain", lambda p: list(p.extensions.gain), _none),
        "extensions.gain",
        "brightness changes that exposure and ISO do not explain",
        "frame brightness changes without a matching change of exposure or ISO",
        applied=lambda p: (
            f"gain of {len(p.extensions.gain)} frames: kept, it scales each whole frame" if p.extensions.gain else ""
        ),
    ),
    Effect(
        "defocus",
        BLUR,
        _value("sigma_px", _extension("defocus_sigma_px"), _none),
        "extensions.defocus",
        "the picture is out of focus",
        "the picture is defocused by a Gaussian of {sigma_px} px",
        applied=_applied("defocus_sigma_px", "defocus of {e.defocus_sigma_px:g} px: undone with the blur"),
    ),
    Effect(
        "sharpening",
        EDGES,
        (*_value("amount", _estimated("amount"), _none), *_value("radius_px", _estimated("radius_px"), _none)),
        "",
        "the phone sharpened its frames",
        "the phone sharpened its frames with an unsharp mask (amount {amount}, radius {radius_px} px)",
    ),
)

EFFECTS: dict[str, Effect] = {effect.name: effect for effect in (*_POINTS, *_LIGHT)}
"""By name."""


def is_sought(name: str, fitted: Collection[str], profile: CameraProfile) -> bool:
    """Whether an effect stands alone, or refines one that is among the fitted ones or in the profile."""
    coarser = EFFECTS[name].beside
    if not coarser or coarser in fitted:
        return True
    return any(np.any(value) for value in EFFECTS[coarser].read(profile, profile).values())
