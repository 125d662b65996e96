"""``virest calibrate-curve SOURCE``: the response curve from bracketed stills or a capture of a static scene."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import yaml

from virest.app.console import table
from virest.app.outputs import require_file, require_no_input, write_whole
from virest.calibration.bracket_samples import BracketPicture
from virest.calibration.response_curve import CurveFit, fit_response
from virest.camera.profile_file import response_block
from virest.camera.response import ResponseCurve
from virest.capture.detect import is_capture
from virest.capture.folder import read_capture
from virest.capture.stills import Still, capture_bracket, read_bracket
from virest.errors import CaptureError, OutputError, SettingsError, printable
from virest.report.figures import FORMATS, response_figure

log = logging.getLogger(__name__)

DIGITS = 8
"""Significant digits of a written curve."""


def calibrate_curve(
    source: Path,
    *,
    exposures: Path | None = None,
    kind: str = "auto",
    out: Path | None = None,
    plot: Path | None = None,
    overwrite: bool = False,
) -> tuple[dict[str, Any], str]:
    """Fit the curve and write its files; returns the mapping for ``--json`` and the printed table.

    out: YAML with the ``response:`` block; plot: figure, its format by its suffix.  Raises CaptureError,
    CalibrationError, OutputError; nothing is written then.
    """
    for option, path in (("--out", out), ("--plot", plot)):
        if path:
            require_no_input(path, [exposures] if exposures else [], option)
            require_file(path, overwrite=overwrite, option=option)
    if out and plot and out.absolute() == plot.absolute():
        raise OutputError(f"{out}: is named by both --out and --plot", hint="name two files")
    stills, notes = read_source(source, exposures)
    fit = fit_response([BracketPicture(s.file, s.levels, s.exposure) for s in stills], kind)
    facts = as_json(fit, stills, notes)
    figure = response_figure(fit, source.resolve().name, plot.suffix[1:].lower()) if plot else b""
    if out:
        write_whole(out, format_curve(facts).encode())
    if plot:
        write_whole(plot, figure)
    return facts, describe(facts, out, plot)


def plot_format_known(path: Path) -> bool:
    """Whether a figure can be written under this name."""
    return path.suffix[1:].lower() in FORMATS


def read_source(source: Path, exposures: Path | None) -> tuple[list[Still], list[str]]:
    """The pictures of a folder of stills or of a capture, and notes about them."""
    if not is_capture(source):
        return read_bracket(source, exposures)
    if exposures is not None:
        text = f"{source}: is a capture, whose exposures are logged"
        raise CaptureError(text, hint="omit --exposures, or pass a folder of stills")
    return capture_bracket(read_capture(source))


def as_json(fit: CurveFit, stills: list[Still], notes: list[str]) -> dict[str, Any]:
    """The result as a mapping, for ``--json``."""
    return {
        "response": _rounded(response_block(fit.curve)),
        "rms_grey_levels": fit.rms_grey_levels,
        "curve_std_grey_levels": fit.curve_std_grey_levels,
        "covered_exposure": list(fit.covered_exposure),
        "pictures": [
            {
                "file": p.file,
                "exposure_s": still.exposure_s,
                "exposure_error_ev": p.exposure_error_ev,
                "contradicts": p.contradicts,
                "likely_exposure_s": p.likely_exposure / still.gain,
            }
            for p, still in zip(fit.pictures, stills, strict=True)
        ],
        "held_out_rms_grey_levels": fit.held_out,
        "notes": [*notes, *fit.notes],
    }


def _rounded(block: dict[str, Any]) -> dict[str, Any]:
    # Rounding may make two neighbouring table entries equal; all digits are written then.
    def shorten(value: Any) -> Any:
        if isinstance(value, list):
            return [shorten(item) for item in value]
        return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value

    short: dict[str, Any] = {key: shorten(value) for key, value in block.items()}
    try:
        arguments: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in short.items()}
        ResponseCurve(**arguments)
    except SettingsError:
        return block
    return short


def format_curve(facts: dict[str, Any]) -> str:
    """The ``response:`` block for camera.yaml as YAML, with fit error and covered range as comments."""
    low, high = facts["covered_exposure"]
    lines = [
        "# Exposure characteristic curve by virest calibrate-curve; put the block into camera.yaml.",
        f"# fit error: {facts['rms_grey_levels']:.3f} grey levels rms; exposures covered: {low:.6g} to {high:.6g}",
        f"# the curve is known to +- {facts['curve_std_grey_levels']:.3f} grey levels (standard deviation) there",
    ]
    for p in facts["pictures"]:
        error = "left out" if p["exposure_error_ev"] is None else f"{round(p['exposure_error_ev'], 3) + 0.0:+.3f} EV"
        mark = f", contradicts the others; likely {p['likely_exposure_s']:.6g} s" if p["contradicts"] else ""
        lines.append(f"# {printable(p['file'])}: {p['exposure_s']:.6g} s, error {error}{mark}")
    block = yaml.safe_dump({"response": facts["response"]}, sort_keys=False, default_flow_style=None, width=110)
    return "\n".join(lines) + "\n" + block


def _shown(value: float | list[float]) -> str:
    """A number of a curve, or a point, to four digits; the file holds all digits."""
    return f"({', '.join(map(_shown, value))})" if isinstance(value, list) else f"{value:.4g}"


def describe(facts: dict[str, Any], out: Path | None, plot: Path | None) -> str:
    """The printed result: one line for the curve, a table of the pictures, the notes."""
    rows = []
    for p in facts["pictures"]:
        error = "–" if p["exposure_error_ev"] is None else f"{round(p['exposure_error_ev'], 3) + 0.0:+.3f}"
        likely = f"{p['likely_exposure_s']:.6g}" if p["contradicts"] else ""
        verdict = "yes" if p["contradicts"] else "no"
        rows.append([printable(p["file"]), f"{p['exposure_s']:.6g}", error, verdict, likely])
    low, high = facts["covered_exposure"]
    block = dict(facts["response"])
    name = block.pop("kind")
    numbers = ", ".join(f"{key} {_shown(value)}" for key, value in block.items())
    shape = "" if name == "table" else numbers.removeprefix("gamma ")
    lines = [
        f"{name} {shape}".strip(),
        f"fit error {facts['rms_grey_levels']:.2f} grey levels rms over exposures {low:.4g} to {high:.4g}",
        f"the curve is known to ± {facts['curve_std_grey_levels']:.2f} grey levels there",
        table(["picture", "exposure_s", "error_ev", "contradicts", "likely_s"], rows),
    ]
    lines += [f"note: {printable(note)}" for note in facts["notes"]]
    lines += [f"wrote {path}" for path in (out, plot) if path]
    return "\n".join(lines)
