"""The printed text of ``virest diagnose``: a table of causes, a sentence each, the remaining residual, the verdict."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from virest.app.console import cell, numeric_table
from virest.diagnosis.findings import Diagnosis, Finding, Remaining
from virest.diagnosis.restoration_gain import RestorationGain
from virest.report.words import SHOWN_COMPONENTS, residual_words


def describe(name: str, found: Diagnosis, gain: RestorationGain, wrote: str) -> str:
    """The table of causes, the gain for restored frames, the remaining residual, files written, the verdict."""
    nominal = found.nominal
    lines = [
        f"{name}: {nominal.tracks} tracks in {nominal.frames} frames, residual "
        f"{residual_words(nominal.geometry_rms_px, nominal.geometry_noise_px)}"
    ]
    if found.causes:
        header = ["cause", "parameter", "given", "found", "±", "before", "after", "gain"]
        lines.append(numeric_table(header, [row for cause in found.causes for row in _rows(cause)]))
        lines += [line for cause in found.causes for line in _sentences(cause)]
    for field in found.fields:
        lines.append(f"field: {_one_line(field.sentence)}")
        lines.append(f"  likely: {field.reasons}; to confirm: {field.next}")
    lines += [_gain_line(gain), _remaining_line(found.unexplained)]
    lines += [f"note: {_one_line(note)}" for note in found.notes]
    lines.append(f"wrote {wrote}")
    return "\n".join([*lines, f"verdict: {found.verdict}"])


def _sentences(cause: Finding) -> list[str]:
    """The cause in words with its error measure, and the rivals that explain as much."""
    rivals = ", ".join(f"{rival.name} ({_number(rival.held_out_after)})" for rival in cause.rivals)
    sentence = f"{cause.name}: {_one_line(cause.sentence)} (held-out {cause.held_out.quantity})"
    return [sentence, f"  equally good explanations: {rivals}"] if rivals else [sentence]


def _rows(cause: Finding) -> list[list[str]]:
    """One row per number or word that changed; the first row also shows what the cause gains."""
    held_out = cause.held_out
    judged = [_number(held_out.before), _number(held_out.after), cell(held_out.gain, ".0%")]
    values = [value for parameter, change in cause.parameters.items() for value in _values(parameter, change)]
    return [
        [cause.name if k == 0 else "", *value, *(judged if k == 0 else [""] * len(judged))]
        for k, value in enumerate(values or [["-"] * 4])
    ]


def _values(parameter: str, change: Any) -> list[list[str]]:
    """Name, given, found, ± of a parameter: one row per component of a short list."""
    found = change.estimate
    if not isinstance(found, list | tuple | np.ndarray):
        return [[parameter, *map(_number, (change.nominal, found, change.std))]]
    count = len(found)
    if count > SHOWN_COMPONENTS:
        known = np.asarray(found, float)
        return [[parameter, "-", f"{count} values, {_number(known.min())} to {_number(known.max())}", "-"]]
    given, std = (_as_list(values, count) for values in (change.nominal, change.std))
    return [[f"{parameter}[{k}]", *map(_number, (given[k], found[k], std[k]))] for k in range(count)]


def _as_list(values: Any, count: int) -> list[Any]:
    listed = isinstance(values, list | tuple | np.ndarray) and len(values) == count
    return list(values) if listed else [values] * count


def _number(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return value if isinstance(value, str) else f"{float(value):.4g}"


def _gain_line(gain: RestorationGain) -> str:
    if not gain.frames:
        return "restored: the capture is too short to hold frames out of the fits"
    if math.isnan(gain.sharpness_after):
        return "restored: no two neighbouring frames could be registered"
    return (
        f"restored: sharpness {_number(gain.sharpness_recorded)} recorded, {_number(gain.sharpness_before)} as given, "
        f"{_number(gain.sharpness_after)} extended; neighbours disagree by "
        f"{_number(gain.disagreement_before_px)} -> {_number(gain.disagreement_after_px)} px"
    )


def _remaining_line(left: Remaining) -> str:
    if left.significant:
        return f"unexplained: {_one_line(left.sentence) or f'{_number(left.size)} along {left.strongest_along}'}"
    return f"no significant residual: {_number(left.size)} {left.unit} along {left.strongest_along}"


def _one_line(text: str) -> str:
    return " ".join(text.split())
