"""The table of effects: one entry each, and nowhere else.

An effect is added here, in the forward model (``image_formation`` or ``motion``), and, from its definition, in the
simulator.  Light effects are fitted by the estimators of their evidence; those that move points by their steps here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.camera.gyro_filter import delay_s
from virest.camera.profile import CameraProfile
from virest.camera.shutter import READOUT_DIRECTIONS, STAMP_FRACTION
from virest.effects import changes as by
from virest.effects.records import BLUR, EDGES, GEOMETRY, PHOTOMETRY, Calibrated, Choice, Effect, Parameter, Steps

Array = NDArray[np.float64]
INF = float("inf")
Read = Callable[[CameraProfile], Any]


def _own(value: Any, std: Array) -> float:
    return float(std[0])


def _relative(value: Any, std: Array) -> float:
    """The step is a logarithm."""
    return float(std[0]) * abs(float(value))


def _each(value: Any, std: Array) -> list[float]:
    return [float(s) for s in std]


def _second_relative(value: Any, std: Array) -> float:
    return float(std[1]) * abs(float(value))


def _of_cutoff(value: Any, std: Array) -> float:
    """The step is the delay τ of a cutoff √2 / (2π τ), whose relative deviation is the same."""
    return float(std[0]) * abs(float(value)) / max(delay_s(value), 1e-9)


def _none(value: Any, std: Array) -> None:
    """Its estimator says it."""


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


def _applied(size: str, text: str) -> Callable[[CameraProfile], str]:
    """A line for the log where the extension ``size`` is on; {} is filled with the extensions."""
    return lambda profile: text.format(e=profile.extensions) if getattr(profile.extensions, size) else ""


GYRO_SCALE_OFF = 0.15
"""Makers trim gyroscopes to 3 % (BMI160, LSM6DSO, ICM-20602: sensitivity tolerance); five times that is a fault."""
ANOTHER_LENS = 1.2
"""In logarithms: a phone's lenses lie between 0.5 and 3 times the main one."""
SENSOR_TURNED = 3.2
"""Radians: a sensor may sit any way round, and drivers swap and turn its axes."""
CLOCK_SKEW_OFF = 0.02
"""Crystals keep 1e-4, recorders that write another clock's rate 0.5 %."""

_POINTS = (
    Effect(
        "time_offset",
        GEOMETRY,
        _value("time_offset_s", lambda p: p.time_offset_s),
        "imu.time_offset_s",
        "camera and gyroscope clocks stand apart",
        "the inertial clock runs {time_offset_s} s off the camera's",
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
        "one of the two clocks runs faster",
        "the two clocks drift apart by {clock_skew} s a second",
        Steps(
            by.skew_clock,
            _difference(lambda p: p.clock_skew),
            (1e-4,),
            (0.005,),
            (0.05,),
            0.03,
            ((-0.003,), (0.003,)),
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
        "the rows are read in another time",
        "the rows are read within {readout_time_s} s",
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
        "the rows are read in another direction",
        "the sensor is read {readout_direction}",
        choice=Choice(READOUT_DIRECTIONS, lambda p, word: by.with_shutter(p, readout_direction=word)),
    ),
    Effect(
        "timestamp_reference",
        GEOMETRY,
        _value("timestamp", lambda p: p.shutter.timestamp, _none),
        "shutter.timestamp",
        "the frame stamps mean another instant of the exposure",
        "a frame's stamp means its {timestamp}",
        choice=Choice(tuple(STAMP_FRACTION), lambda p, word: by.with_shutter(p, timestamp=word)),
    ),
    Effect(
        "exposure_time",
        BLUR,
        _value("exposure_scale", lambda p: p.shutter.exposure_scale, _relative),
        "shutter.exposure_scale",
        "the exposure lasts longer or shorter than logged",
        "the true exposure is {exposure_scale} times the logged one",
        Steps(by.scale_exposure, _log_ratio(lambda p: p.shutter.exposure_scale), (0.05,), (0.3,), (0.7,), 1.5),
        calibrated=Calibrated(
            "exposure_scale",
            lambda p: p.shutter.exposure_scale,
            lambda p, given: by.with_shutter(p, exposure_scale=given.shutter.exposure_scale),
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
        "the gyroscope reads a rate at rest",
        "the gyroscope reads {gyro_bias_rad_s} rad/s at rest",
        Steps(by.add_bias, _difference(lambda p: p.gyro_bias_rad_s), (1e-3,) * 3, (0.05,) * 3, (0.1,) * 3, 0.5),
        calibrated=Calibrated(
            "gyro_bias_rad_s", lambda p: list(p.gyro_bias_rad_s), by.keep_value("gyro_bias_rad_s"), 0.006
        ),
    ),
    Effect(
        "gyro_scale",
        GEOMETRY,
        _value("gyro_scale", lambda p: float(np.mean(p.gyro_scale)), _relative),
        "imu.gyro_scale",
        "the gyroscope reads too much or too little",
        "the gyroscope's rates are {gyro_scale} times the true ones",
        Steps(by.scale_gyro, _log_ratio(lambda p: p.gyro_scale[0]), (1e-3,), (0.1,), (0.3,), 0.4),
        calibrated=Calibrated(
            "gyro_scale",
            lambda p: p.gyro_scale[0],
            by.keep_value("gyro_scale"),
            0.02,
            "gyro-scale",
            GYRO_SCALE_OFF,
            True,
        ),
    ),
    Effect(
        "gyro_lowpass",
        GEOMETRY,
        _value("gyro_lowpass_hz", _extension("gyro_lowpass_hz"), _of_cutoff),
        "extensions.gyro_lowpass_hz",
        "the gyroscope reads late, and fast turns too small",
        "the gyroscope's rates pass a filter of {gyro_lowpass_hz} Hz: they come late, and fast ones too small",
        Steps(
            by.delay_gyro,
            _difference(lambda p: delay_s(p.extensions.gyro_lowpass_hz)),
            (1e-4,),
            (0.01,),
            (INF,),
            0.1,
            ((0.006,), (0.02,)),
        ),
        applied=_applied("gyro_lowpass_hz", "gyroscope's low pass of {e.gyro_lowpass_hz:g} Hz: undone"),
    ),
    Effect(
        "imu_rotation",
        GEOMETRY,
        (Parameter("rotation_rad", lambda p, given: by.rotation_between(given, p).tolist(), _each),),
        "imu.T_cam_imu",
        "the gyroscope's axes are turned against the camera's",
        "the inertial sensor sits turned by {rotation_rad} rad against the camera",
        Steps(by.rotate_imu, by.rotation_between, (1e-3,) * 3, (0.1,) * 3, (INF,) * 3, SENSOR_TURNED),
        calibrated=Calibrated("rotation_rad", lambda p: None, by.keep_value("r_cam_imu"), 0.01),
    ),
    Effect(
        "focal_length",
        GEOMETRY,
        (Parameter("focal_scale", lambda p, given: _focal(p) / _focal(given), _relative),),
        "intrinsics.fx_px, fy_px",
        "the focal length is another",
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
        "the focal length changes by {focal_drift_per_s} of itself a second (refocusing)",
        Steps(by.drift_focal, _difference(_extension("focal_drift_per_s")), (1e-3,), (0.03,), (0.2,), 0.3),
        applied=_applied("focal_drift_per_s", "focal drift of {e.focal_drift_per_s:+g} a second: followed"),
    ),
    Effect(
        "radial_distortion",
        GEOMETRY,
        _value("k1", by.k1_of),
        "intrinsics.distortion",
        "the lens bends straight lines",
        "the lens bends rays by k1 = {k1}",
        Steps(by.add_k1, _difference(by.k1_of), (1e-3,), (0.1,), (0.5,), 0.8),
        calibrated=Calibrated("k1", by.k1_of, by.keep_lens("model", "coefficients"), 0.03, "distortion", 0.3),
    ),
    Effect(
        "principal_point",
        GEOMETRY,
        (Parameter("offset_px", lambda p, given: by.principal_shift(given, p).tolist(), _each),),
        "intrinsics.cx_px, cy_px",
        "the optical axis meets the picture elsewhere",
        "the optical axis meets the picture {offset_px} px from where the profile says",
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
        ),
        "extensions.stabilisation",
        "an optical stabiliser moves the lens",
        "the lens is moved against the shake: it cancels {fraction} of what is faster than {cutoff_hz} Hz",
        Steps(
            by.stabilise,
            by.stabilised_between,
            (0.02, 0.1, 0.01, 0.01),
            (0.3, 0.5, 0.1, 0.1),
            (1.0, 1.5, 0.05, 0.05),
            1.1,
            ((0.5, 0.0, 0.0, 0.0), (0.5, 1.2, 0.0, 0.0), (0.5, -1.2, 0.0, 0.0)),
        ),
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
        "the scene is at another distance",
        "the camera travels before a scene {depth_m} m away, so points move by parallax",
    ),
    Effect(
        "frame_lag",
        GEOMETRY,
        (
            *_value("lag_s", _extension("frame_lag_s"), _none),
            *_value("frames", _extension("frame_lag_frames"), _none),
        ),
        "extensions.frame_lag",
        "pictures come later than their stamps while the recorder starts",
        "the first {frames} frames show pictures up to {lag_s} s later than their stamps",
        applied=_applied(
            "frame_lag_frames",
            "frame lag of {e.frame_lag_s:g} s at the start: first {e.frame_lag_frames} frames at their true times",
        ),
    ),
)

_LIGHT = (
    Effect(
        "response_curve",
        PHOTOMETRY,
        _value("gamma", _curve("extra_gamma", 1.0), _none),
        "extensions.response_gamma",
        "the exposure curve is bent otherwise",
        "the grey levels follow a gamma of {gamma} on top of the profile's curve",
    ),
    Effect(
        "black_level",
        PHOTOMETRY,
        _value("black_level", _curve("black_level", 0.0), _none),
        "extensions.black_level",
        "black is stored as grey",
        "no light at all reads {black_level} of full scale",
    ),
    Effect(
        "vignetting",
        PHOTOMETRY,
        _value("corner_loss", _extension("vignetting_corner_loss"), _none),
        "extensions.vignetting",
        "the corners get less light",
        "the corners lose {corner_loss} of the light",
        applied=_applied(
            "vignetting_corner_loss", "vignetting of {e.vignetting_corner_loss:g}: moved with the picture's place"
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
        "the light pulses",
        "the lamps pulse by {amplitude} at {frequency_hz} Hz",
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
        "brightness changes from frame to frame without exposure or ISO saying so",
        applied=lambda p: (
            f"gain of {len(p.extensions.gain)} frames: kept, it is common to a whole frame" if p.extensions.gain else ""
        ),
    ),
    Effect(
        "defocus",
        BLUR,
        _value("sigma_px", _extension("defocus_sigma_px"), _none),
        "extensions.defocus",
        "the picture is out of focus",
        "the picture is out of focus by a Gaussian of {sigma_px} px",
        applied=_applied("defocus_sigma_px", "defocus of {e.defocus_sigma_px:g} px: undone with the blur"),
    ),
    Effect(
        "sharpening",
        EDGES,
        (*_value("amount", lambda p: 0.0, _none), *_value("radius_px", lambda p: 0.0, _none)),
        "",
        "the phone sharpened its pictures",
        "the phone sharpened its pictures by an unsharp mask of {amount} with a radius of {radius_px} px",
    ),
)

EFFECTS: dict[str, Effect] = {effect.name: effect for effect in (*_POINTS, *_LIGHT)}
"""By name."""
