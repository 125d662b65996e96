"""Figures as image files in memory; matplotlib is loaded only when one is drawn, and never opens a window."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from virest.calibration.response_curve import CurveFit

FORMATS = ("png", "svg", "pdf")
MAX_POINTS = 12_000
DPI = 110


def response_figure(fit: CurveFit, title: str = "", image_format: str = "png") -> bytes:
    """The curve with its data, the residuals over grey level, and the exposure error of every picture.

    image_format: one of FORMATS.  Returns the file's bytes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.3, 1.0))
    _draw_curve(figure.add_subplot(grid[:, 0]), fit, title)
    _draw_residuals(figure.add_subplot(grid[0, 1]), fit)
    _draw_pictures(figure.add_subplot(grid[1, 1]), fit)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=image_format, dpi=DPI, metadata={} if image_format == "png" else None)
    return buffer.getvalue()


def _literal(text: str) -> str:
    """Text that is drawn as it stands: no formula, one line."""
    return "".join(c if c.isprintable() else "?" for c in text).replace("$", r"\$")


def _thinned(fit: CurveFit) -> slice:
    return slice(None, None, max(len(fit.cloud.grey) // MAX_POINTS, 1))


def _draw_curve(axes: Any, fit: CurveFit, title: str) -> None:
    cloud, part = fit.cloud, _thinned(fit)
    axes.scatter(cloud.light[part], cloud.grey[part], c=cloud.picture[part], s=3, cmap="viridis", alpha=0.35,
                 linewidths=0, rasterized=True)  # fmt: skip
    low, high = fit.covered_exposure
    light = np.geomspace(max(low, 1e-6) * 0.5, high * 1.3, 500)
    axes.plot(light, 255 * fit.curve.encode(light), color="crimson", lw=1.8, label=fit.curve.describe())
    axes.axvspan(max(low, 1e-6), high, color="0.92", zorder=0, label="covered by data")
    axes.set_xscale("log")
    axes.set_xlim(light[0], light[-1])
    axes.set_ylim(-5, 260)
    axes.set_xlabel("exposure, the curve's own unit")
    axes.set_ylabel("grey level")
    axes.set_title(f"{_literal(title)}  rms {fit.rms_grey_levels:.2f} levels".strip())
    axes.legend(loc="upper left")


def _draw_residuals(axes: Any, fit: CurveFit) -> None:
    cloud, part = fit.cloud, _thinned(fit)
    axes.scatter(cloud.grey[part], cloud.residual[part], c=cloud.picture[part], s=3, cmap="viridis", alpha=0.35,
                 linewidths=0, rasterized=True)  # fmt: skip
    edges = np.linspace(0, 255, 25)
    place = np.digitize(cloud.grey, edges)
    used = [i for i in range(1, len(edges)) if (place == i).sum() > 10]
    middle = [0.5 * (edges[i - 1] + edges[i]) for i in used]
    axes.plot(middle, [float(np.median(cloud.residual[place == i])) for i in used], color="crimson", lw=1.8)
    limit = max(5.0 * fit.rms_grey_levels, 1.0)
    axes.set_ylim(-limit, limit)
    axes.axhline(0, color="0.5", lw=0.8)
    axes.set_xlabel("grey level")
    axes.set_ylabel("measured − curve, levels")
    axes.set_title("residuals, and their median")


def _draw_pictures(axes: Any, fit: CurveFit) -> None:
    errors = [0.0 if p.exposure_error_ev is None else p.exposure_error_ev for p in fit.pictures]
    colours = ["crimson" if p.contradicts else "steelblue" for p in fit.pictures]
    axes.bar(range(len(errors)), errors, color=colours)
    axes.axhline(0, color="0.5", lw=0.8)
    reach = max(0.05, 1.15 * max(abs(e) for e in errors))
    axes.set_ylim(-reach, reach)
    labels = [p.file if len(p.file) <= 18 else "…" + p.file[-17:] for p in fit.pictures]
    axes.set_xticks(range(len(errors)), [_literal(text) for text in labels], rotation=60, ha="right",
                    fontsize=8)  # fmt: skip
    axes.set_ylabel("listed / true exposure, EV")
    axes.set_title("exposure error of each picture")
