"""Explanatory figures drawn from the program's own records: blur paths over a frame, the row clock, the axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Picture
from virest.report.figures import as_file, canvas
from virest.restoration.parameters import TileBlur

KERNEL_IN = 1.15
"""Side of a kernel in the figure, inches."""


def strip_figure(pictures: Sequence[tuple[str, Picture]]) -> bytes:
    """Pictures (h, w, 3) of one size side by side, each labelled, at one figure pixel per picture pixel."""
    height, width = pictures[0][1].shape[:2]
    figure = canvas(width * len(pictures) / 110 + 0.2, height / 110 + 0.4)
    for axes, (name, picture) in zip(figure.subplots(1, len(pictures), squeeze=False)[0], pictures, strict=True):
        axes.imshow(picture, cmap="gray", interpolation="antialiased")
        axes.set_title(name, fontsize=10)
        axes.set_axis_off()
    return as_file(figure, "png")


def blur_figure(
    picture: Picture,
    centres_px: Array,
    chords_px: Array,
    kernels: NDArray[np.float32],
    shown: Sequence[int],
    scale: float = 3.0,
) -> bytes:
    """A recorded frame with its predicted blur as arrows, and the kernels of a few arrows beside it.

    picture: (h, w, 3).  centres_px, chords_px: (n, 2) position and displacement of image points during their own row's
    exposure.  kernels: (n, k, k).  shown: the arrows whose kernels are drawn.  scale: magnification of the arrows.
    """
    height, width = picture.shape[:2]
    tall = 5.0
    figure = canvas(tall * width / height + 2 * KERNEL_IN + 0.6, tall + 0.3)
    grid = figure.add_gridspec(-(-len(shown) // 2), 4, width_ratios=(tall * width / height, 0.05, KERNEL_IN, KERNEL_IN))
    axes = figure.add_subplot(grid[:, 0])
    axes.imshow(picture)
    x, y = centres_px.T
    u, v = chords_px.T * scale
    axes.quiver(x - u / 2, y - v / 2, u, v, angles="xy", scale_units="xy", scale=1, color="gold", width=0.004)
    axes.set_title(f"predicted blur, arrows × {scale:g}", fontsize=9)
    axes.set_axis_off()
    for number, index in enumerate(shown):
        axes.text(*centres_px[index], str(number + 1), color="white", fontsize=11, fontweight="bold", ha="right")
        place = figure.add_subplot(grid[number // 2, 2 + number % 2])
        place.imshow(kernels[index], cmap="magma")
        place.set_title(f"kernel at {number + 1}", fontsize=8)
        place.set_xticks([])
        place.set_yticks([])
    return as_file(figure, "png")


def rows_figure(row_start_s: Array, exposure_s: float, middle_s: float) -> bytes:
    """The row clock of one frame: when each row is exposed, and the two reference times of `process`.

    row_start_s: (h,) start of each row's exposure after the frame's timestamp.  middle_s: the instant ``frame-middle``.
    """
    figure = canvas(7.0, 3.4)
    axes = figure.subplots()
    rows = np.arange(len(row_start_s))
    axes.fill_betweenx(rows, 1e3 * row_start_s, 1e3 * (row_start_s + exposure_s), color="steelblue", alpha=0.35)
    axes.plot(1e3 * row_start_s, rows, color="steelblue", lw=1.5, label="row starts its exposure")
    axes.plot(1e3 * (row_start_s + exposure_s), rows, color="steelblue", lw=1.5, ls="--", label="row ends it")
    axes.axvline(0, color="crimson", lw=1.2, label="exposure-start = the stamp")
    axes.axvline(1e3 * middle_s, color="darkorange", lw=1.2, label="frame-middle")
    axes.invert_yaxis()
    axes.set_xlabel("time after the frame's stamp, ms")
    axes.set_ylabel("row")
    axes.legend(fontsize=8, loc="lower left")
    return as_file(figure, "png")


def axes_figure() -> bytes:
    """Camera axes, picture axes, the sign of angles, and the axes of an Android phone held upright."""
    figure = canvas(8.6, 3.6)
    left, right = figure.subplots(1, 2)
    _draw_picture_axes(left)
    _draw_phone_axes(right)
    return as_file(figure, "png")


def _draw_picture_axes(axes: Any) -> None:
    axes.add_patch(_rectangle(4, 3))
    _arrow(axes, (0, 0), (1.6, 0), "x: u, right", "crimson", (0.1, -0.18))
    _arrow(axes, (0, 0), (0, 1.6), "y: v, down", "seagreen", (0.1, 0.1))
    axes.text(0.12, 0.42, "(0, 0) is the centre of\nthe top-left pixel", fontsize=7)
    _arrow(axes, (2.2, 1.9), (3.4, 2.5), "", "black", (0, 0))
    axes.plot([2.2, 3.5], [1.9, 1.9], color="0.6", lw=0.8)
    axes.text(3.3, 2.25, "angle > 0", fontsize=8)
    axes.text(0.2, 2.8, "z points into the scene", fontsize=8)
    _frame(axes, (-0.6, 4.6), (3.6, -0.6), "stored picture and camera axes")


def _draw_phone_axes(axes: Any) -> None:
    axes.add_patch(_rectangle(1.8, 3.4))
    _arrow(axes, (0.9, 1.7), (2.3, 1.7), "x IMU = x camera", "crimson", (0.05, -0.12))
    _arrow(axes, (0.9, 1.7), (0.9, 0.1), "y IMU", "seagreen", (0.08, 0.3))
    _arrow(axes, (0.9, 1.7), (0.9, 3.1), "y camera", "darkorange", (0.03, 0.2))
    axes.text(2.0, 2.9, "the screen faces you:\nz IMU points to you,\nz camera away from you", fontsize=8)
    _frame(axes, (-0.6, 4.0), (3.9, -0.5), "Android phone, upright: T_cam_imu = diag(1, −1, −1)")


def _rectangle(width: float, height: float) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((0, 0), width, height, fill=False, edgecolor="0.4", lw=1.2)


def _arrow(
    axes: Any, tail: Sequence[float], tip: Sequence[float], text: str, colour: str, shift: tuple[float, float]
) -> None:
    axes.annotate("", xy=tip, xytext=tail, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8})
    axes.text(tip[0] + shift[0], tip[1] + shift[1], text, color=colour, fontsize=8)


def _frame(axes: Any, x: tuple[float, float], y: tuple[float, float], title: str) -> None:
    axes.set_xlim(*x)
    axes.set_ylim(*y)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title, fontsize=9)


def preview_figure(recorded: Picture, restored: Picture, tiles: Sequence[TileBlur], title: str) -> bytes:
    """Recorded frame, restored frame, and the recorded frame with arrows along its blur."""
    height, width = recorded.shape[:2]
    tall = 6.0 if height > width else 4.0
    figure = canvas(3 * tall * width / height + 0.3, tall + 0.7)
    left, middle, right = figure.subplots(1, 3)
    for axes, picture, name in ((left, recorded, "recorded"), (middle, restored, "restored"), (right, recorded, "")):
        axes.imshow(picture)
        axes.set_title(name, fontsize=10)
        axes.set_axis_off()
    longest = max((tile.length_px for tile in tiles), default=0.0)
    if longest > 0:
        scale = max(1.0, float(np.floor(0.12 * min(height, width) / longest)))
        x, y = np.array([tile.centre_px for tile in tiles]).T
        length = scale * np.array([tile.length_px for tile in tiles])
        angle = np.array([tile.angle_rad for tile in tiles])
        u, v = length * np.cos(angle), length * np.sin(angle)
        right.quiver(x - u / 2, y - v / 2, u, v, angles="xy", scale_units="xy", scale=1, color="gold", width=0.006)
        right.set_title(f"blur × {scale:g}, up to {longest:.1f} px", fontsize=10)
    figure.suptitle(title, fontsize=10)
    return as_file(figure, "png")
