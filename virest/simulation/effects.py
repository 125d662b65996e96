"""Hidden effects: what the true camera does but its nominal profile omits (contract, section 4).

Each effect of the table has one entry here: how its values change the profile, and how they are drawn when none are
given.  The simulator renders with the true profile and writes the nominal one beside the movie.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from virest.camera.profile import CameraProfile
from virest.effects.table import EFFECTS as TABLE
from virest.errors import SettingsError
from virest.simulation.phone_isp import OFF, PhoneIsp

DIRECTIONS = ("top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left")
OPPOSITE = dict(zip(DIRECTIONS, ("bottom_to_top", "top_to_bottom", "right_to_left", "left_to_right"), strict=True))
STAMPS = ("exposure_start", "exposure_middle", "exposure_end")


@dataclass(frozen=True, slots=True)
class EffectContext:
    """Inputs to the random default of an effect."""

    frames: int
    fps: float
    rng: np.random.Generator


@dataclass(frozen=True, slots=True)
class Effect:
    """A named effect."""

    draw: Callable[[CameraProfile, EffectContext], list[Any]]
    """Draws the values when none are given."""
    apply: Callable[[CameraProfile, list[Any]], CameraProfile]
    """Returns the profile with the effect applied."""
    words: tuple[str, ...] = ()
    """Allowed values of an effect whose value is a word."""
    per_frame: bool = False
    """Whether the effect has one value per frame, drawn at a given RMS if VALUE is a single number (gain_drift)."""
    optional: int = 0
    """Number of trailing parameters that VALUE may omit; omitted ones are drawn."""
    allow_infinity: bool = False
    """Whether infinity is a valid value (scene_depth: rotation only)."""
    parameters: tuple[str, ...] = ()
    """Parameter names in the order of VALUE, from the table of effects."""
    strengths: tuple[str, ...] = ()
    """Fields of PhoneIsp that take the values, for an effect that no profile stores."""


@dataclass(frozen=True, slots=True)
class AppliedEffect:
    """An effect and its values."""

    name: str
    parameters: dict[str, Any]


def hide_effects(
    nominal: CameraProfile, texts: list[str] | tuple[str, ...], context: EffectContext
) -> tuple[CameraProfile, tuple[AppliedEffect, ...]]:
    """Apply effects, each ``NAME`` or ``NAME=VALUE[,VALUE…]``, to the nominal profile: true profile, applied effects.

    Effects without VALUE draw theirs from ``context.rng``.
    """
    true, applied, seen = nominal, [], set()
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip().replace("-", "_")
        effect = _find_effect(name)
        if name in seen:
            raise SettingsError(f"effect '{name}' is given twice", hint="give each effect once")
        seen.add(name)
        values = effect.draw(nominal, context)
        if equals:
            values = _parse_values(name, effect, value, values, context)
        true = effect.apply(true, values)
        listed = effect.per_frame or len(effect.parameters) != len(values)
        named = zip(effect.parameters, values, strict=not listed)
        shown = {effect.parameters[0]: values} if listed else {key: v for key, v in named if v is not None}
        applied.append(AppliedEffect(name, shown))
    return true, tuple(applied)


def hidden_isp(applied: Sequence[AppliedEffect], isp: PhoneIsp = OFF) -> PhoneIsp:
    """The phone's processing with the effects that no profile stores."""
    for one in applied:
        isp = replace(isp, **dict(zip(EFFECTS[one.name].strengths, one.parameters.values(), strict=False)))
    return isp


def _find_effect(name: str) -> Effect:
    if name in EFFECTS:
        return EFFECTS[name]
    near = difflib.get_close_matches(name, EFFECTS, n=1, cutoff=0.5)
    hint = f"did you mean '{near[0]}'?" if near else f"use one of {', '.join(EFFECTS)}"
    raise SettingsError(f"effect '{name}' is not known", hint=hint)


def _parse_values(name: str, effect: Effect, text: str, drawn: list[Any], context: EffectContext) -> list[Any]:
    parts = [part.strip(" []()") for part in text.split(",")]
    if effect.words:
        if parts[0] not in effect.words or len(parts) != 1:
            raise SettingsError(f"effect {name}: '{text}' is not allowed", hint=f"use one of {', '.join(effect.words)}")
        return list(parts)
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        raise SettingsError(f"effect {name}: '{text}' is not a number", hint="write NAME=0.1 or NAME=0.1,0.2") from None
    if not all(math.isfinite(n) or (n == math.inf and effect.allow_infinity) for n in numbers):
        raise SettingsError(f"effect {name}: '{text}' is not a finite number", hint="write NAME=0.1 or NAME=0.1,0.2")
    if effect.per_frame:
        if len(numbers) not in (1, context.frames):
            raise SettingsError(
                f"effect {name} got {len(numbers)} factors for {context.frames} frames",
                hint="write one size, or one factor per frame",
            )
        return _gain_walk(context, numbers[0]) if len(numbers) == 1 else numbers
    wanted = len(drawn)
    if not wanted - effect.optional <= len(numbers) <= wanted:
        raise SettingsError(
            f"effect {name} takes {wanted} number(s), got {len(numbers)}", hint=", ".join(effect.parameters)
        )
    return numbers + drawn[len(numbers) :]


# ── the table ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _signed(context: EffectContext, low: float, high: float) -> float:
    """Draw a value of random sign and of magnitude between low and high."""
    return round(float(context.rng.uniform(low, high) * context.rng.choice((-1, 1))), 6)


def _between(context: EffectContext, low: float, high: float) -> float:
    return round(float(context.rng.uniform(low, high)), 6)


def _lens(profile: CameraProfile, **changes: Any) -> CameraProfile:
    if profile.intrinsics is None:
        raise SettingsError("this effect needs a profile with intrinsics", hint="set intrinsics.fx_px")
    return replace(profile, intrinsics=replace(profile.intrinsics, **changes))


def _rotate_imu(profile: CameraProfile, values: list[float]) -> CameraProfile:
    rotation = Rotation.from_rotvec(values).as_matrix() @ profile.rotation_cam_imu
    return replace(profile, r_cam_imu=tuple(map(tuple, rotation.tolist())))


def _scale_focal(profile: CameraProfile, values: list[float]) -> CameraProfile:
    lens = _lens(profile).intrinsics
    assert lens is not None
    return _lens(profile, fx_px=lens.fx_px * values[0], fy_px=lens.fy_px * values[0])


def _stretch_pixels(profile: CameraProfile, values: list[float]) -> CameraProfile:
    """Multiply fy by the value; fx is unchanged."""
    lens = _lens(profile).intrinsics
    assert lens is not None
    return _lens(profile, fy_px=lens.fy_px * values[0])


def _shift_principal_point(profile: CameraProfile, values: list[float]) -> CameraProfile:
    lens = _lens(profile).intrinsics
    assert lens is not None
    return _lens(profile, cx_px=lens.cx_px + values[0], cy_px=lens.cy_px + values[1])


def _bend_radially(profile: CameraProfile, coefficient: int, value: float) -> CameraProfile:
    """Set ``k1`` (0) or ``k2`` (1); the other distortion coefficients are unchanged."""
    lens = _lens(profile).intrinsics
    assert lens is not None
    coefficients = [0.0] * 5 if lens.model == "none" else list(lens.coefficients)
    coefficients[coefficient] = value
    return _lens(profile, model="radtan" if lens.model == "none" else lens.model, coefficients=tuple(coefficients))


def _draw_axes(_: CameraProfile, context: EffectContext) -> list[float]:
    x, y = (round(1 + _signed(context, 0.02, 0.04), 6) for _ in range(2))
    return [x, y, round(1 / (x * y), 6), *(_signed(context, 0.01, 0.03) for _ in range(3))]


def _skew_axes(profile: CameraProfile, values: list[float]) -> CameraProfile:
    """Multiply the scales of the gyroscope's axes x, y, z; add the misalignment of xy, xz, yz."""
    scale = np.multiply(profile.gyro_scale, values[:3])
    turned = np.add(profile.extensions.gyro_misalignment_rad, values[3:])
    skewed = profile.with_extensions(gyro_misalignment_rad=tuple(turned.tolist()))
    return replace(skewed, gyro_scale=tuple(scale.tolist()))


def _draw_frame_lag(_: CameraProfile, context: EffectContext) -> list[float]:
    repeats = max(1, min(int(context.rng.integers(3, 8)), context.frames // 3))
    return [round(repeats / context.fps, 6), float(min(3 * repeats, context.frames - 1))]


def _gain_walk(context: EffectContext, rms: float) -> list[float]:
    """Draw one gain per frame: a smooth drift of the given RMS in log light, median 1."""
    if abs(rms) > 5:
        raise SettingsError(f"effect gain_drift: {rms:g} in log light is too much", hint="use about 0.1")
    k = np.arange(context.frames)
    drift = sum(
        np.cos(2 * np.pi * k / period + context.rng.uniform(0, 2 * np.pi)) for period in (7.0, 17.0, 41.0)
    )  # fmt: skip
    gain = np.exp(rms * drift / max(float(np.std(drift)), 1e-9))
    return [round(float(g), 6) for g in gain / np.median(gain)]


def _replace_gain(profile: CameraProfile, values: list[float]) -> CameraProfile:
    if any(v <= 0 for v in values):
        raise SettingsError("effect gain_drift: gains must be positive", hint="a list with one factor per frame")
    return profile.with_extensions(gain=tuple(values))


_BY_NAME: dict[str, Effect] = {
    "time_offset": Effect(
        lambda p, c: [_signed(c, 0.004, 0.015)],
        lambda p, v: replace(p, time_offset_s=(p.time_offset_s or 0.0) + v[0]),
    ),
    "clock_skew": Effect(
        lambda p, c: [_signed(c, 0.002, 0.005)],
        lambda p, v: replace(p, clock_skew=p.clock_skew + v[0]),
    ),
    "readout_time": Effect(
        lambda p, c: [round(p.shutter.readout_time_s * (1 + _signed(c, 0.15, 0.3)), 6)],
        lambda p, v: p.with_shutter(readout_time_s=v[0]),
    ),
    "readout_direction": Effect(
        lambda p, c: [OPPOSITE[p.shutter.readout_direction]],
        lambda p, v: p.with_shutter(readout_direction=v[0]),
        words=DIRECTIONS,
    ),
    "timestamp_reference": Effect(
        lambda p, c: [str(c.rng.choice([s for s in STAMPS if s != p.shutter.timestamp]))],
        lambda p, v: p.with_shutter(timestamp=v[0]),
        words=STAMPS,
    ),
    "exposure_time": Effect(
        lambda p, c: [round(float(np.exp(_signed(c, 0.25, 0.45))), 4)],
        lambda p, v: p.with_shutter(exposure_scale=p.shutter.exposure_scale * v[0]),
    ),
    "gyro_bias": Effect(
        lambda p, c: [_signed(c, 0.02, 0.06) for _ in range(3)],
        lambda p, v: replace(p, gyro_bias_rad_s=tuple(a + b for a, b in zip(p.gyro_bias_rad_s, v, strict=True))),
    ),
    "gyro_scale": Effect(
        lambda p, c: [round(1 + _signed(c, 0.03, 0.06), 6)],
        lambda p, v: replace(p, gyro_scale=tuple(s * v[0] for s in p.gyro_scale)),
    ),
    "gyro_axes": Effect(_draw_axes, _skew_axes),
    "gyro_lowpass": Effect(
        lambda p, c: [_between(c, 8.0, 20.0)],
        lambda p, v: p.with_extensions(gyro_lowpass_hz=v[0]),
    ),
    "gyro_averaging": Effect(
        lambda p, c: [_between(c, 0.008, 0.015)],
        lambda p, v: p.with_extensions(gyro_averaging_s=v[0]),
    ),
    "imu_rotation": Effect(lambda p, c: [_signed(c, 0.015, 0.04) for _ in range(3)], _rotate_imu),
    "focal_length": Effect(lambda p, c: [round(1 + _signed(c, 0.03, 0.06), 6)], _scale_focal),
    "pixel_aspect": Effect(lambda p, c: [round(1 + _signed(c, 0.02, 0.05), 6)], _stretch_pixels),
    "focal_drift": Effect(
        lambda p, c: [_signed(c, 0.01, 0.03)],
        lambda p, v: p.with_extensions(focal_drift_per_s=v[0]),
    ),
    "radial_distortion": Effect(lambda p, c: [_signed(c, 0.04, 0.1)], lambda p, v: _bend_radially(p, 0, v[0])),
    "higher_distortion": Effect(lambda p, c: [_signed(c, 0.04, 0.1)], lambda p, v: _bend_radially(p, 1, v[0])),
    "principal_point": Effect(
        lambda p, c: [_signed(c, 0.01 * max(p.width, p.height), 0.03 * max(p.width, p.height)) for _ in range(2)],
        _shift_principal_point,
    ),
    "stabilisation": Effect(
        lambda p, c: [_between(c, 0.4, 0.8), _between(c, 0.5, 1.5), None],
        lambda p, v: p.with_extensions(
            stabilisation_fraction=v[0], stabilisation_cutoff_hz=v[1], stabilisation_travel_rad=v[2]
        ),
        optional=2,
    ),
    "scene_depth": Effect(
        lambda p, c: [_between(c, 0.4, 0.9)], lambda p, v: replace(p, depth_m=v[0]), allow_infinity=True
    ),
    "frame_lag": Effect(
        _draw_frame_lag,
        lambda p, v: p.with_extensions(frame_lag_s=v[0], frame_lag_frames=int(v[1])),
        optional=1,
    ),
    "response_curve": Effect(
        lambda p, c: [round(float(np.exp(_signed(c, 0.15, 0.3))), 4)],
        lambda p, v: p.with_curve(extra_gamma=v[0]),
    ),
    "black_level": Effect(lambda p, c: [_between(c, 0.03, 0.08)], lambda p, v: p.with_curve(black_level=v[0])),
    "vignetting": Effect(
        lambda p, c: [_between(c, 0.3, 0.6)], lambda p, v: p.with_extensions(vignetting_corner_loss=v[0])
    ),
    "flicker": Effect(
        lambda p, c: [_between(c, 0.15, 0.4), float(c.rng.choice([100.0, 120.0])), _between(c, 0, 6.28)],
        lambda p, v: p.with_extensions(flicker_amplitude=v[0], flicker_frequency_hz=v[1], flicker_phase_rad=v[2]),
        optional=2,
    ),
    "gain_drift": Effect(lambda p, c: _gain_walk(c, 0.12), _replace_gain, per_frame=True),
    "defocus": Effect(lambda p, c: [_between(c, 1.0, 2.0)], lambda p, v: p.with_extensions(defocus_sigma_px=v[0])),
    "sharpening": Effect(
        lambda p, c: [_between(c, 0.7, 1.2), _between(c, 1.0, 1.8)],
        lambda p, v: p,
        optional=1,
        strengths=("sharpen", "sharpen_radius_px"),
    ),
}

_PARTS = {
    **dict.fromkeys(("gyro_bias", "imu_rotation"), ("x", "y", "z")),
    "gyro_axes": ("x", "y", "z", "xy", "xz", "yz"),
    "principal_point": ("x", "y"),
}
"""Component names of vector effects."""

EFFECTS = {
    name: replace(_BY_NAME[name], parameters=_PARTS.get(name, tuple(one.name for one in effect.parameters)))
    for name, effect in TABLE.items()
}
"""All effects in the table, by name."""
