"""What a recorder logs about its camera: medians over the metadata's rows, checked for plausibility."""

from __future__ import annotations

import numpy as np

from virest.arrays import Array
from virest.capture.records import CaptureMetadata, Note
from virest.capture.source import Source

PLAUSIBLE_FOCAL = (0.55, 1.1)
"""fx over the long side of a phone's main camera."""
BEARABLE_FOCAL = (0.4, 1.6)
"""Outside, fx is not in pixels of the movie but of the sensor's active array."""
THOUSANDTH_S = 34e-6
"""The longest exposure at 30 frames/s, a thousand times too short: without longer ones, the unit is in doubt."""
PLAUSIBLE_ASPECT = (0.5, 2.0)
"""fy over fx: 1 for square pixels, up to 16:9 for stretched movies."""


def summarise(files: Source, notes: list[Note]) -> CaptureMetadata:
    """Medians over the rows; where the rows have none, the recorder's own description of camera and axes.

    fx in the rows belongs to the sensor's long axis, which is vertical in a portrait picture.
    """
    lens = files.profile.intrinsics if files.profile else None
    readout_s = files.profile.shutter.readout_time_s if files.profile and files.profile.readout_known else None
    table, name = files.metadata, files.names.metadata
    if table is None:
        return CaptureMetadata(lens.fx_px if lens else None, lens.fy_px if lens else None, readout_s)
    fx, fy = _median(table.fx_px), _median(table.fy_px)
    if fx is None and lens is not None:
        fx, fy = lens.fx_px, lens.fy_px
    elif not _focal_plausible(fx, files.movie.width, files.movie.height, name, notes):
        fx = fy = None
    elif fx and fy and not PLAUSIBLE_ASPECT[0] <= fy / fx <= PLAUSIBLE_ASPECT[1]:
        notes.append(Note("warning", "fy-implausible", f"{name}: fy {fy:.4g} px beside fx {fx:.4g} px is ignored"))
        fy = None
    elif files.movie.height > files.movie.width:
        fx, fy = fy, fx
    logged_s = _median(table.readout_time_s)
    if logged_s is None and readout_s is None:
        notes.append(Note("info", "readout-unknown", f"{name} has no readout time"))
    if _median(table.exposure_s) is None:
        why = "has no exposure times"
        if table.odd_exposure_s is not None:
            why = f"has exposure times such as {table.odd_exposure_s:.3g} s (are they in the header's unit?)"
        notes.append(Note("warning", "exposure-unknown", f"{name} {why}: no deblurring"))
    elif (longest_s := float(np.nanmax(table.exposure_s))) < THOUSANDTH_S:
        text = f"{name} has no exposure time above {1e6 * longest_s:.3g} µs (are they in the header's unit?)"
        notes.append(Note("warning", "exposure-short", text))
    return CaptureMetadata(
        fx_px=fx,
        fy_px=fy,
        readout_time_s=readout_s if logged_s is None else logged_s,
        exposure_s=_median(table.exposure_s),
        iso=_median(table.iso),
        focal_length_mm=_median(table.focal_length_mm),
    )


def _median(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else None


def _focal_plausible(fx: float | None, width: int, height: int, name: str, notes: list[Note]) -> bool:
    if fx is None:
        text = f"{name} has no focal length: give fx_px in camera.yaml, or let `virest calibrate` find it"
        notes.append(Note("warning", "fx-unknown", text))
        return False
    ratio = fx / max(width, height)
    if not BEARABLE_FOCAL[0] <= ratio <= BEARABLE_FOCAL[1]:
        text = (
            f"fx {fx:.1f} is {ratio:.2f} of the picture's long side ({max(width, height)} px), phones have "
            f"{PLAUSIBLE_FOCAL[0]}–{PLAUSIBLE_FOCAL[1]}: it is in pixels of the sensor's active array, not of the "
            "movie, and is ignored. Multiply it by long side / array width, or calibrate; give fx_px in camera.yaml"
        )
        notes.append(Note("warning", "fx-active-array", text))
        return False
    if not PLAUSIBLE_FOCAL[0] <= ratio <= PLAUSIBLE_FOCAL[1]:
        usual = f"{PLAUSIBLE_FOCAL[0]}–{PLAUSIBLE_FOCAL[1]}"
        text = f"fx {fx:.1f} is {ratio:.2f} of the picture's long side, unusual for a phone ({usual})"
        notes.append(Note("warning", "fx-unusual", text))
    return True
