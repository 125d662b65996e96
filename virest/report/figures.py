"""Figures as image files in memory; matplotlib is loaded only when needed, and never opens a window."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from virest.arrays import Array, Index, Mask, Picture
from virest.calibration.response_curve import CurveFit
from virest.capture.pixels import BT601_LUMA
from virest.errors import printable

FORMATS = ("png", "svg", "pdf")
MAX_POINTS = 12_000
"""Drawn points of a cloud; more only make the file larger."""
DPI = 110
"""1200 pixels for a figure of 11 inches, the width of the page."""
DARK, ON_DARK = "#1b1f22", "#e4e6e8"
"""Background of figures with photographs, and text on it."""
COVARIATES = {"row": "fraction of the readout", "time": "time, s", "radius": "radius, px", "rate": "rate, rad/s"}
"""Covariates of residual plots, with axis labels."""
RESIDUALS = ("x_px", "y_px")
BINS, MIN_IN_BIN = 24, 8
"""Most bins of a plot over a covariate, and fewest points of a bin: the median of eight is known to 0.4 σ."""
LEAST_BARS = 3
"""A rung with fewer candidates is drawn with room for this many."""
MOST_DEVIATIONS, DEVIATION_BARS = 4.0, 16
"""A normal error beyond 4 σ is one of 16 000; bars are half a σ wide."""

RungBars = tuple[str, float, Mapping[str, float], str | None]


def response_figure(fit: CurveFit, title: str = "", image_format: str = "png") -> bytes:
    """The curve with its data, the residuals over grey level, and the exposure error of every picture.

    image_format: one of FORMATS.  Returns the file's bytes.
    """
    figure = canvas(11.0, 7.5)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.3, 1.0))
    _draw_curve(figure.add_subplot(grid[:, 0]), fit, title)
    _draw_residuals(figure.add_subplot(grid[0, 1]), fit)
    _draw_pictures(figure.add_subplot(grid[1, 1]), fit)
    return as_file(figure, image_format)


def literal(text: str) -> str:
    """Text drawn literally: no math mode, one line."""
    return printable(text).replace("$", r"\$")


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
    axes.set_title(f"{literal(title)}  rms {fit.rms_grey_levels:.2f} levels".strip())
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
    axes.set_xticks(range(len(errors)), [literal(text) for text in labels], rotation=60, ha="right",
                    fontsize=8)  # fmt: skip
    axes.set_ylabel("listed / true exposure, EV")
    axes.set_title("exposure error of each picture")


# ── a diagnosis ──────────────────────────────────────────────────────────────────────────────────────────────────


def comparison_figure(
    rows: Sequence[tuple[str, Picture, Picture]], title: str = "", image_format: str = "png"
) -> bytes:
    """Measured picture, simulated picture and their difference, one row per (label, measured, simulated).

    8-bit pictures (h, w) or (h, w, 3).  Differences are of luma on one common scale; their rms is in the title.
    The background is dark whatever the colours of the page.
    """
    figure = canvas(11.0, 0.6 + 3.0 * len(rows))
    figure.set_facecolor(DARK)
    axes = figure.subplots(len(rows), 3, squeeze=False)
    differences = [_luma(measured) - _luma(simulated) for _, measured, simulated in rows]
    reach = max(1.0, *(float(np.percentile(np.abs(d), 99)) for d in differences))
    for line, (label, measured, simulated), difference in zip(axes, rows, differences, strict=True):
        for place, picture, name in zip(line, (measured, simulated), ("measured", f"simulated, {label}"), strict=False):
            place.imshow(picture, cmap="gray", vmin=0, vmax=255)
            place.set_title(literal(name), fontsize=9, color=ON_DARK)
        shown = line[2].imshow(difference, cmap="RdBu_r", vmin=-reach, vmax=reach)
        rms = float(np.sqrt(np.mean(difference**2)))
        line[2].set_title(f"measured − simulated, rms {rms:.1f} levels", fontsize=9, color=ON_DARK)
        figure.colorbar(shown, ax=line[2], shrink=0.8).ax.tick_params(colors=ON_DARK)
        for place in line:
            place.set_xticks([])
            place.set_yticks([])
    figure.suptitle(literal(title), color=ON_DARK)
    return as_file(figure, image_format)


def residual_figure(
    before: Mapping[str, Any], after: Mapping[str, Any], title: str = "", image_format: str = "png"
) -> bytes:
    """Residuals along x and y over row, time, radius and rate: medians in bins of equal count, and the central 68 %.

    before, after: covariate name → (n,), and ``x_px``, ``y_px`` (n,).  The legend gives the rms as `diagnose` prints
    it: per coordinate, with large residuals capped.
    """
    names = [name for name in COVARIATES if name in before or name in after]
    sets = (("before", "0.45", before), ("after", "steelblue", after))
    figure = canvas(3.4 * max(len(names), 1), 5.6)
    axes = figure.subplots(2, max(len(names), 1), squeeze=False, sharey="row")
    for line, component in zip(axes, RESIDUALS, strict=True):
        for place, name in zip(line, names, strict=False):
            for _, colour, data in sets:
                if name in data and component in data:
                    _draw_binned(place, np.asarray(data[name]), np.asarray(data[component]), colour)
            place.axhline(0, color="0.7", lw=0.8, zorder=0)
            place.set_xlabel(COVARIATES[name])
        line[0].set_ylabel(f"residual along {component[0]}, px")
    for label, colour, data in sets:
        if all(len(data.get(component, ())) for component in RESIDUALS):
            text = f"{label}: rms {_printed_rms(*(data[component] for component in RESIDUALS)):.3g} px"
            axes[0][0].plot([], [], color=colour, lw=1.6, marker=".", label=text)
    figure.suptitle(literal(title))
    handles, labels = axes[0][0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return as_file(figure, image_format)


def deviation_figure(ratios: Mapping[str, Sequence[float]], title: str = "", image_format: str = "png") -> bytes:
    """Histograms of errors in standard deviations, one per name, with the normal distribution.

    ratios: name → errors divided by their standard deviations; those beyond ± 4 go to the outermost bars.
    """
    columns = min(max(len(ratios), 1), 4)
    lines = -(-max(len(ratios), 1) // columns)
    figure = canvas(2.6 * columns, 0.4 + 2.1 * lines)
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True)
    edges = np.linspace(-MOST_DEVIATIONS, MOST_DEVIATIONS, DEVIATION_BARS + 1)
    along = np.linspace(-MOST_DEVIATIONS, MOST_DEVIATIONS, 161)
    for place in axes.flat[len(ratios) :]:
        place.set_axis_off()
    for place, (name, values) in zip(axes.flat, ratios.items(), strict=False):
        inside = np.clip(np.asarray(values, float), edges[0] + 1e-9, edges[-1] - 1e-9)
        place.hist(inside, edges, density=True, color="steelblue")
        place.plot(along, np.exp(-(along**2) / 2) / np.sqrt(2 * np.pi), color="0.3", lw=1.2)
        place.set_title(literal(f"{name}: {len(inside)} errors"), fontsize=9)
        place.set_yticks([])
    figure.supxlabel("error / standard deviation")
    figure.suptitle(literal(title))
    return as_file(figure, image_format)


def ladder_figure(rungs: Sequence[RungBars], title: str = "", image_format: str = "png") -> bytes:
    """Candidates of each rung, the best on top, with the one that entered; the line is the error before the rung.

    rungs: (quantity, before, {name: after}, entered or None).
    """
    most = max([LEAST_BARS, *(len(tried) for _, _, tried, _ in rungs)])
    figure = canvas(4.2 * max(len(rungs), 1), 1.3 + 0.26 * most)
    axes = figure.subplots(1, max(len(rungs), 1), squeeze=False)[0]
    for number, (place, rung) in enumerate(zip(axes, rungs, strict=False), start=1):
        entered = rung[3] or "no candidate gains enough"
        name = f"{number}. {entered}" if len(rungs) > 1 else "" if rung[3] else entered
        _draw_rung(place, rung, most, name)
    figure.suptitle(literal(title))
    return as_file(figure, image_format)


def _draw_rung(axes: Any, rung: RungBars, most: int, name: str) -> None:
    """Bars of one rung, as thick as if there were ``most`` of them; the error before stands above its line.

    Causes are judged on held-out frames; a rung without any has only the error of its fit.
    """
    quantity, before, tried, entered = rung
    known = sorted((after, name) for name, after in tried.items() if np.isfinite(after))
    names = [name for _, name in known]
    colours = ["steelblue" if name == entered else "0.75" for name in names]
    axes.barh(range(len(names)), [after for after, _ in known], color=colours)
    axes.set_yticks(range(len(names)), [literal(name) for name in names], fontsize=8)
    axes.set_ylim(most - 0.5, -0.5)
    if np.isfinite(before):
        axes.axvline(before, color="crimson", lw=1.2)
        side = "right" if before > 0.5 * axes.get_xlim()[1] else "left"
        axes.annotate(f"before: {before:.3g}", (before, 1), xycoords=("data", "axes fraction"), xytext=(0, 3),
                      textcoords="offset points", ha=side, color="crimson", fontsize=8)  # fmt: skip
    held_out = ", held-out frames" if known else ""
    axes.set_xlabel(literal(quantity) + held_out)
    if name:
        axes.set_title(literal(name), fontsize=10, pad=18)


def equal_bins(along: Array, known: Mask) -> list[Index]:
    """Index of the known points in bins of equal count along the covariate; empty with too few points for a bin."""
    numbers = np.flatnonzero(known)
    if len(numbers) < MIN_IN_BIN:
        return []
    order = numbers[np.argsort(along[numbers], kind="stable")]
    return np.array_split(order, min(BINS, len(order) // MIN_IN_BIN))


def _draw_binned(axes: Any, along: Array, residual: Array, colour: str) -> None:
    shares = equal_bins(along, np.isfinite(along) & np.isfinite(residual))
    if not shares:
        return
    middle = [float(np.median(along[share])) for share in shares]
    low, centre, high = (np.array([np.percentile(residual[share], q) for share in shares]) for q in (16, 50, 84))
    axes.fill_between(middle, low, high, color=colour, alpha=0.2, lw=0)
    axes.plot(middle, centre, color=colour, lw=1.6, marker=".")


def _printed_rms(x_px: Any, y_px: Any) -> float:
    """Capped rms per coordinate, as for ``geometry_rms_px``; NaN where no residual is finite."""
    from virest.diagnosis.geometric_evidence import capped_rms

    distance = np.hypot(np.asarray(x_px, float), np.asarray(y_px, float))
    known = distance[np.isfinite(distance)]
    return capped_rms(known) if len(known) else float("nan")


def _luma(picture: Picture) -> Array:
    values = np.asarray(picture, float)
    return values if values.ndim == 2 else values @ np.array(BT601_LUMA)


def canvas(width_in: float, height_in: float) -> Any:
    """An empty figure of this size in inches, without a window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def as_file(figure: Any, image_format: str) -> bytes:
    """The figure as the bytes of a file; image_format: one of FORMATS."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=image_format, dpi=DPI, metadata={} if image_format == "png" else None)
    return buffer.getvalue()
