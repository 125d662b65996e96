"""Numbers and verdicts as text: a value with unit and standard deviation, a cause in plain words."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from virest.effects.table import EFFECTS

DIAGNOSIS_WORDS = {
    "consistent": ("good", "The camera model fits this capture"),
    "explained": ("fair", "The camera model is wrong, and the causes were found"),
    "unexplained": ("poor", "The camera model is wrong, and no known effect explains all of the error"),
}
CAUSE_WORDS = {name: effect.in_words for name, effect in EFFECTS.items()}
QUANTITY_WORDS = {
    "geometry_rms_px": "points, px",
    "photometric_rms": "brightness, grey levels",
    "blur_rms_px": "blur, px",
    "edge_profile_rms": "edges, fraction of the step",
}
FIGURE_WORDS = {
    "residuals": "Residuals (tracked − predicted points) over row, time, radius and rate",
    "ladder": "Candidates tried on each rung of the ladder, the best on top",
    "pictures": "A high-motion frame beside its simulation",
}
UNITS = {
    "_rad_s": "rad/s",
    "_m_s": "m/s",
    "_per_s": "1/s",
    "_px": "px",
    "_rad": "rad",
    "_hz": "Hz",
    "_m": "m",
    "_s": "s",
}
PARAMETER_WORDS = {
    "time_offset_s": "Time offset",
    "readout_time_s": "Readout time",
    "readout_direction": "Readout direction",
    "timestamp": "Timestamps mark",
    "exposure_scale": "Exposure scale",
    "clock_skew": "Clock skew",
    "gyro_bias_rad_s": "Gyroscope bias",
    "gyro_scale": "Gyroscope scale",
    "gyro_lowpass_hz": "Gyroscope low pass",
    "gyro_averaging_s": "Gyroscope averaging",
    "axis_scale": "Gyroscope axes, scale",
    "misalignment_rad": "Gyroscope axes, xy, xz, yz",
    "fx_px": "Focal length",
    "fy_px": "Focal length, vertical",
    "pixel_aspect": "fy / fx",
    "response": "Exposure curve",
    "depth_m": "Scene depth",
}
CAMERA_KEYS = (
    ("imu", "time_offset_s"),
    ("shutter", "readout_time_s"),
    ("shutter", "readout_direction"),
    ("imu", "gyro_bias_rad_s"),
    ("intrinsics", "fx_px"),
    ("response", "kind"),
    ("scene", "depth_m"),
)
"""Profile entries that the page always shows."""
DEFAULTS = {"gyro_bias_rad_s": [0.0, 0.0, 0.0], "clock_skew": 0.0, "exposure_scale": 1.0}
"""Default values of a profile; whether they were given or assumed is unknown."""
SHOWN_COMPONENTS = 4
"""Longer lists are summarised, here and in the printed text."""

Mapped = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Verdict:
    """An assessment: its level (``good``, ``fair``, ``poor``), a headline, and a sentence."""

    level: str
    headline: str
    sentence: str


# ── numbers ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _listed(value: Any) -> list[Any] | None:
    return list(value) if isinstance(value, list | tuple | np.ndarray) else None


def number(value: Any, digits: int = 4) -> str:
    """A number as text, or a word such as ``unknown``."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "unknown"
    if isinstance(value, bool | str):
        return str(value).replace("inf", "infinity") if value in ("inf", "-inf") else str(value)
    return f"{float(value):.{digits}g}".replace("-", "−") if isinstance(value, int | float) else str(value)


def with_deviation(name: str, value: Any, std: Any = None) -> str:
    """A value with unit and standard deviation, rounded to two digits of the latter: ``14.91 ± 0.05 ms``.

    The unit follows from the name's ending; seconds are shown as milliseconds.
    """
    values, spread = _listed(value), _listed(std)
    if values is not None:
        if len(values) > SHOWN_COMPONENTS:
            return f"{len(values)} values"
        stds = spread if spread is not None and len(spread) == len(values) else [std] * len(values)
        return "; ".join(with_deviation(name, v, s) for v, s in zip(values, stds, strict=True))
    unit = next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")
    if not isinstance(value, int | float) or isinstance(value, bool):
        return number(value)
    factor, unit = (1e3, "ms") if unit == "s" else (1.0, unit)
    return f"{_rounded(factor * value, None if std is None else factor * std)} {unit}".strip()


def _rounded(value: float, std: Any) -> str:
    if not isinstance(std, int | float) or not math.isfinite(std) or std <= 0 or not math.isfinite(value):
        return number(value, 5)
    decimals = 1 - math.floor(math.log10(std))
    if not -6 < decimals < 9:
        return f"{number(value, 5)} ± {number(std, 2)}"
    shown_value, shown_std = (f"{round(v, decimals):.{max(decimals, 0)}f}" for v in (value, std))
    return f"{shown_value} ± {shown_std}".replace("-", "−")


@dataclass(frozen=True, slots=True)
class CameraValue:
    """A camera parameter that the run used."""

    title: str
    text: str
    source: str
    estimated: bool


def camera_values(profile: Mapped, profile_source: str) -> list[CameraValue]:
    """The main camera parameters; estimated ones with standard deviation and method."""
    estimates = profile.get("estimates")
    estimates = estimates if isinstance(estimates, Mapping) else {}
    plain = {keys[-1] if keys[0] != "response" else "response": _inside(profile, keys) for keys in CAMERA_KEYS}
    names = dict.fromkeys([*plain, *estimates])
    return [_camera_value(name, plain.get(name), estimates.get(name), profile_source) for name in names]


def _inside(mapping: Any, keys: Sequence[str]) -> Any:
    for key in keys:
        mapping = mapping.get(key) if isinstance(mapping, Mapping) else None
    return mapping


def _camera_value(name: str, value: Any, estimate: Any, profile_source: str) -> CameraValue:
    title = PARAMETER_WORDS.get(name, name)
    if not isinstance(estimate, Mapping):
        given = f"given by {profile_source}" if value != DEFAULTS.get(name) else f"{profile_source}, or the default"
        source = "unknown" if value is None else given
        return CameraValue(title, with_deviation(name, value).replace("_", " "), source, False)
    text = with_deviation(name, estimate.get("value"), estimate.get("std"))
    return CameraValue(title, text, str(estimate.get("source") or "estimated"), True)


# ── a diagnosis ──────────────────────────────────────────────────────────────────────────────────────────────────


def diagnosis_verdict(verdict: str, causes: Sequence[Mapped], nominal: Mapped) -> Verdict:
    """The diagnosis in words."""
    level, headline = DIAGNOSIS_WORDS.get(verdict, ("fair", verdict))
    named = ", ".join(str(cause["name"]).replace("_", " ") for cause in causes)
    words = [f"Found: {named}." if named else ""]
    if nominal.get("geometry_rms_px") is not None:
        words.append(
            "Residual of tracked points: "
            f"{residual_words(nominal['geometry_rms_px'], nominal.get('geometry_noise_px'))}"
            f" ({number(nominal.get('tracks'), 9)} tracks in {number(nominal.get('frames'), 9)} frames)."
        )
    return Verdict(level, headline, " ".join(filter(None, words)))


def residual_words(residual_px: Any, noise_px: Any) -> str:
    """A residual with the tracking noise, which is measured separately and may be larger."""
    shown, noise = f"{number(residual_px, 3)} px", f"{number(noise_px, 3)} px"
    known = all(isinstance(value, int | float) for value in (residual_px, noise_px))
    if known and residual_px < noise_px:
        return f"{shown}, no more than tracking noise ({noise})"
    return f"{shown} (tracking noise {noise})"


def cause_view(cause: Mapped) -> dict[str, Any]:
    """One row of the table of causes."""
    held_out = cause.get("held_out") or {}
    before, after, gain = (held_out.get(name) for name in ("before", "after", "gain"))
    name = str(cause["name"])
    return {
        "title": name.replace("_", " "),
        "sentence": str(cause.get("sentence") or CAUSE_WORDS.get(name, "")),
        "parameters": [
            (
                PARAMETER_WORDS.get(parameter, parameter),
                with_deviation(parameter, change.get("nominal")),
                with_deviation(parameter, change.get("estimate"), change.get("std")),
            )
            for parameter, change in (cause.get("parameters") or {}).items()
        ],
        "quantity": QUANTITY_WORDS.get(str(held_out.get("quantity")), str(held_out.get("quantity", ""))),
        "before": number(before, 3),
        "after": number(after, 3),
        "left": _part(after, before),
        "gain": f"{gain:.0%}" if isinstance(gain, int | float) else "unknown",
        "rivals": [
            f"{str(rival.get('name')).replace('_', ' ')} ({number(rival.get('held_out_after'), 3)})"
            for rival in cause.get("rivals") or ()
        ],
    }


def _part(after: Any, before: Any) -> float | None:
    """The remaining fraction of the error, 0 to 1, for a bar."""
    if not all(isinstance(v, int | float) and math.isfinite(v) for v in (after, before)) or not before > 0:
        return None
    return round(min(max(after / before, 0.0), 1.0), 4)


def remaining_words(unexplained: Mapped, verdict: str) -> str:
    """The residual that no cause explains, in a sentence.

    One that is too small to matter may have any p value: with enough points everything is significant.
    """
    along = str(unexplained.get("strongest_along") or "nothing in particular")
    value, size, limit = (unexplained.get(key) for key in ("p_value", "size", "limit"))
    p_value = "p unknown" if value is None else f"p = {number(value, 2)}"
    if verdict == "unexplained":
        return f"The remaining residual is significant ({p_value}), strongest along {along}."
    if size is not None and limit is not None and size <= limit:
        sizes = f"{number(size, 2)} {unexplained.get('unit', '')}".rstrip()
        return f"What remains, {sizes} along {along}, is below the {number(limit, 2)} that count as a model error."
    return f"No significant residual ({p_value}, strongest along {along})."


def gain_words(gain: Mapped) -> list[tuple[str, str]]:
    """What the causes gain on restored frames, one line per measure."""
    lines = []
    if gain.get("sharpness_after") is not None:
        shares = [number(gain.get(f"sharpness_{name}"), 3) for name in ("recorded", "before", "after")]
        lines.append(
            ("Sharpness", f"{shares[0]} recorded, {shares[1]} with the profile as given, {shares[2]} extended")
        )
    if gain.get("disagreement_after_px") is not None:
        shares = [number(gain.get(f"disagreement_{name}_px"), 3) for name in ("before", "after")]
        lines.append(("Restored neighbours disagree by", f"{shares[0]} px as given, {shares[1]} px extended"))
    return lines


def figure_words(name: str) -> str:
    """The caption of a diagnosis figure, by its file name."""
    if re.fullmatch(r"field_\d\d", name):
        return f"Field {int(name[-2:])}: its value over its covariates, and the residuals before and after"
    numbered = re.fullmatch(r"\d\d_([a-z_]+)", name)
    if numbered:
        return f"The rung on which {numbered[1].replace('_', ' ')} entered, with the other candidates"
    return FIGURE_WORDS.get(name, name)
