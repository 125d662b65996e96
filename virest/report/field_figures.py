"""Figures of fields: values with standard deviations, or arrows over the frame, and residuals before and after.

Residuals are rms values of the points in bins of equal count along the covariate, for nominal and extended model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from virest.camera.field import UNIT_SCALES, UNITS, Field
from virest.diagnosis.findings import FieldFinding
from virest.report.figures import COVARIATES, as_file, canvas, equal_bins, literal

SAMPLES, CELLS, ARROWS = 200, 60, 13
"""Points of a drawn curve, cells of a map and arrows along one side: fine enough at the printed size."""
NAMES = {
    "row": "fraction of the readout",
    "time": "time",
    "exposure": "logged exposure",
    "radius": "distance from the principal point",
    "focus": "focus distance",
    "focal": "logged focal length",
    "x": "x",
    "y": "y",
}
RESIDUALS_OVER = {
    "row": "row",
    "radius": "radius",
    "time": "time",
    "rate": "rate",
    "x": "radius",
    "focus": "time",
    "focal": "time",
    "acceleration": "time",
}
COMPONENTS = ("x", "y", "z")


def field_figure(
    finding: FieldFinding,
    title: str = "",
    before: Mapping[str, Any] | None = None,
    after: Mapping[str, Any] | None = None,
    image_format: str = "png",
) -> bytes:
    """A field, and the residuals with and without it; before, after: as `residual_figure` takes them."""
    figure = canvas(11.0, 4.6)
    left, right = figure.subplots(1, 2)
    if finding.kind == "gain":
        _draw_map(figure, left, finding.fields[0])
    elif finding.covariates == ("x", "y"):
        _draw_arrows(figure, left, finding.fields[0])
    elif len(finding.covariates) > 1:
        _draw_pair(figure, left, max(finding.fields, key=lambda field: float(np.abs(field.values).max())))
    else:
        _draw_values(left, finding.fields)
    _draw_residuals(right, RESIDUALS_OVER[finding.covariates[0]], {"before": before, "after": after})
    figure.suptitle(literal(title))
    return as_file(figure, image_format)


def _draw_values(axes: Any, fields: tuple[Field, ...]) -> None:
    """Values of each nonzero component, with one standard deviation."""
    for field in fields:
        factor, unit = UNIT_SCALES[field.kind]
        along = np.linspace(field.knots[0][0], field.knots[0][-1], SAMPLES)
        values = factor * field.at(along)
        spread = (
            factor * np.abs(field.with_values(np.array(field.std)).at(along)) if field.std else np.zeros_like(values)
        )
        for part in np.flatnonzero(np.abs(values).max(axis=0) > 0):
            name = field.covariates[0] + (f" → {COMPONENTS[part]}" if values.shape[1] > 1 else "")
            line = axes.plot(along, values[:, part], lw=1.6, label=name if len(fields) <= 3 else None)[0]
            low, high = values[:, part] - spread[:, part], values[:, part] + spread[:, part]
            axes.fill_between(along, low, high, color=line.get_color(), alpha=0.25, lw=0)
            knots = np.array(field.knots[0])
            axes.plot(knots, factor * np.array(field.values)[:, part], "o", ms=3, color=line.get_color())
        axes.set_ylabel(f"{field.kind}, {unit}")
        axes.set_xlabel(_named(field.covariates[0]))
    axes.axhline(0, color="0.7", lw=0.8, zorder=0)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="best", fontsize=8)
    axes.set_title("value ± standard deviation", fontsize=10)


def _draw_pair(figure: Any, axes: Any, field: Field) -> None:
    """The largest component over two covariates, the second along x."""
    factor, unit = UNIT_SCALES[field.kind]
    fine = [np.linspace(k[0], k[-1], CELLS) for k in field.knots]
    values = factor * field.at(*np.meshgrid(*fine, indexing="ij"))
    values = values[..., int(np.argmax(np.abs(values).max(axis=(0, 1))))]
    most = float(np.abs(values).max())
    shown = axes.pcolormesh(
        fine[1], fine[0], values, cmap="RdBu_r", vmin=-most, vmax=most, shading="auto", rasterized=True
    )
    figure.colorbar(shown, ax=axes, label=f"{field.kind}, {unit}", shrink=0.8)
    axes.set_ylabel(_named(field.covariates[0]))
    axes.set_xlabel(_named(field.covariates[1]))
    if field.std:
        typical = factor * float(np.sqrt(np.mean(np.square(field.std))))
        axes.set_title(f"map; standard deviation {typical:.2g} {unit}", fontsize=10)


def _named(covariate: str) -> str:
    """A covariate's name with its unit."""
    unit = UNITS.get(covariate, "rad/s" if covariate.startswith("rate") else "m/s²")
    return NAMES.get(covariate, covariate) + (f", {unit}" if unit != "1" else "")


def _draw_arrows(figure: Any, axes: Any, field: Field) -> None:
    """Arrows over the frame, on a map of the displacement's length."""
    fine = [np.linspace(k[0], k[-1], CELLS) for k in field.knots]
    length = np.linalg.norm(field.at(*np.meshgrid(*fine)), axis=-1)
    shown = axes.pcolormesh(*fine, length, cmap="viridis", shading="auto", rasterized=True)
    figure.colorbar(shown, ax=axes, label="displacement, px", shrink=0.8)
    x, y = np.meshgrid(*(np.linspace(k[0], k[-1], ARROWS) for k in field.knots))
    values = field.at(x, y)
    axes.quiver(x, y, values[..., 0], values[..., 1], color="white", angles="xy")
    _as_picture(axes)
    if field.std:
        typical = float(np.sqrt(np.mean(np.square(field.std)) * 2))
        axes.set_title(f"vector map; standard deviation {typical:.2g} px", fontsize=10)


def _draw_map(figure: Any, axes: Any, field: Field) -> None:
    """Relative change of brightness over the frame, in %."""
    fine = [np.linspace(k[0], k[-1], CELLS) for k in field.knots]
    values = 100 * field.at(*np.meshgrid(*fine))[..., 0]
    most = float(np.abs(values).max())
    shown = axes.pcolormesh(*fine, values, cmap="RdBu_r", vmin=-most, vmax=most, shading="auto", rasterized=True)
    figure.colorbar(shown, ax=axes, label="light, %", shrink=0.8)
    _as_picture(axes)
    if field.std:
        typical = 100 * float(np.sqrt(np.mean(np.square(field.std))))
        axes.set_title(f"map; standard deviation {typical:.2g} %", fontsize=10)


def _as_picture(axes: Any) -> None:
    """Axes in pixels of the frame, y downwards."""
    axes.invert_yaxis()
    axes.set_aspect("equal")
    axes.set_xlabel("x, px")
    axes.set_ylabel("y, px")


def _draw_residuals(axes: Any, along: str, sets: Mapping[str, Mapping[str, Any] | None]) -> None:
    colours = {"before": "0.45", "after": "steelblue"}
    for label, data in sets.items():
        if not data or along not in data:
            continue
        x, y, covariate = (np.asarray(data[name], float) for name in ("x_px", "y_px", along))
        shares = equal_bins(covariate, np.isfinite(x) & np.isfinite(y) & np.isfinite(covariate))
        if not shares:
            continue
        middle = [float(np.median(covariate[share])) for share in shares]
        rms = [float(np.sqrt(np.mean(x[share] ** 2 + y[share] ** 2) / 2)) for share in shares]
        axes.plot(middle, rms, marker=".", lw=1.6, color=colours[label], label=label)
    axes.set_ylim(0, 1.18 * axes.get_ylim()[1])
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right", ncols=2, fontsize=8)
    axes.set_xlabel(COVARIATES[along])
    axes.set_ylabel("rms of tracked − predicted points, px")
    axes.set_title("residuals of the whole model, before and after", fontsize=10)
