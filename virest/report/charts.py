"""Geometry of SVG time plots, state bands and blur arrows; the templates draw them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from virest.arrays import Array, Mask

WIDTH, HEIGHT = 360.0, 176.0
"""Size of a chart in units of about one phone pixel, so that labels stay readable at that width."""
LEFT, RIGHT, TOP, BOTTOM = 46.0, 10.0, 10.0, 34.0
"""Margins in units of the view box: room for the axis labels."""
MAX_COLUMNS = 300
"""Longer series are drawn by their minimum and maximum in this many columns."""
TICKS = 4
"""As many labels as fit a chart of this height."""
ABSURD = 1e12
"""Absolute values above this, and infinite ones, are not drawn."""
MAX_ARROWS = 80
"""More cannot be told apart in a picture of this size."""
ARROW_SCALES = (1, 2, 3, 5, 8, 12, 20)
"""Whole factors of about 1.5 each."""
ARROW_REACH = 0.9
"""The longest arrow, as a fraction of the distance between arrows."""
HEAD_RAD, HEAD_PART, HEAD_MAX = 0.45, 0.4, 0.016
"""Half the opening of an arrow's head, its length as a part of the arrow, and at most of the picture's diagonal."""

Values = Sequence[float | None]


@dataclass(frozen=True, slots=True)
class Tick:
    """A tick on an axis."""

    place: float
    label: str


@dataclass(frozen=True, slots=True)
class Line:
    """One series."""

    name: str
    path: str
    """The ``d`` of an SVG path, interrupted at missing values."""


@dataclass(frozen=True, slots=True)
class Chart:
    """A time plot, ready for drawing."""

    title: str
    unit: str
    summary: str
    """The chart in words: range and median of each series."""
    lines: tuple[Line, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    marks: tuple[float, ...]
    """Positions of the frames shown on the page."""
    zero: float | None
    """Height of the zero line, if inside the chart."""
    width: float = WIDTH
    height: float = HEIGHT
    left: float = LEFT
    right: float = WIDTH - RIGHT
    top: float = TOP
    bottom: float = HEIGHT - BOTTOM


@dataclass(frozen=True, slots=True)
class Arrow:
    """Shaft and head of an arrow, in pixels of the picture, as the ``d`` of an SVG path."""

    path: str


@dataclass(frozen=True, slots=True)
class ArrowField:
    """The blur of one frame, as an overlay."""

    arrows: tuple[Arrow, ...]
    scale: int
    """Magnification of the arrows relative to the blur."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A run of frames of one state along a band of width 1."""

    state: str
    start: float
    width: float


def time_chart(
    title: str, unit: str, time_s: Array, series: Sequence[tuple[str, Values]], marks_s: Sequence[float]
) -> Chart | None:
    """A time plot; None if no series has a value.

    time_s: (n,) ascending.  series: (name, n values, None for unknown).  marks_s: times to mark.
    """
    columns = [(name, np.array([np.nan if v is None else v for v in values], float)) for name, values in series]
    columns = [(name, np.where(np.abs(values) < ABSURD, values, np.nan)) for name, values in columns]
    columns = [(name, values) for name, values in columns if not np.isnan(values).all()]
    if not columns:
        return None
    low = min(float(np.nanmin(values)) for _, values in columns)
    high = max(float(np.nanmax(values)) for _, values in columns)
    y_marks = nice_ticks(min(low, 0.0), max(high, 0.0))
    first, last = float(time_s[0]), max(float(time_s[-1]), float(time_s[0]) + 1e-6)
    low, high = y_marks[0], y_marks[-1]

    def across(t: float) -> float:
        return round(LEFT + (t - first) / (last - first) * (WIDTH - LEFT - RIGHT), 2)

    def down(v: float) -> float:
        return round(TOP + (high - v) / (high - low) * (HEIGHT - TOP - BOTTOM), 2)

    x_marks = [t for t in nice_ticks(first, last) if first <= t <= last + 1e-9]
    return Chart(
        title,
        unit,
        "; ".join(_in_words(name, values, unit) for name, values in columns),
        tuple(Line(name, _path(*thinned(time_s, values), across, down)) for name, values in columns),
        tuple(Tick(across(t), _short(t, x_marks)) for t in x_marks),
        tuple(Tick(down(v), _short(v, y_marks)) for v in y_marks),
        tuple(across(t) for t in marks_s),
        down(0.0) if low < 0.0 < high else None,
    )


def nice_ticks(low: float, high: float) -> list[float]:
    """About TICKS multiples of 1, 2 or 5 times a power of ten that enclose low to high."""
    span = high - low if high - low > 1e-12 * max(abs(low), abs(high), 1e-12) else max(abs(high), 1.0)
    raw = span / TICKS
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil((low + span) / step - 1e-9)
    return [float(f"{k * step:.12g}") for k in range(first, max(last, first + 1) + 1)]


def thinned(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Minimum and maximum of each of MAX_COLUMNS equal parts, in order; short series unchanged."""
    if len(values) <= 2 * MAX_COLUMNS:
        return time_s, values
    kept: list[int] = []
    for share in np.array_split(np.arange(len(values)), MAX_COLUMNS):
        known = share[~np.isnan(values[share])]
        ends = {int(share[0])} if not len(known) else {int(known[f(values[known])]) for f in (np.argmin, np.argmax)}
        kept += sorted(ends)
    return time_s[kept], values[kept]


def _path(
    time_s: Array, values: Array, across: Callable[[float], float], down: Callable[[float], float]
) -> str:  # fmt: skip
    parts, open_ = [], False
    for k, (t, v) in enumerate(zip(time_s.tolist(), values.tolist(), strict=True)):
        if math.isnan(v):
            open_ = False
            continue
        alone = not open_ and (k + 1 == len(values) or math.isnan(values[k + 1]))
        parts.append(f"{'L' if open_ else 'M'}{across(t):g} {down(v):g}{'h0' if alone else ''}")
        open_ = True
    return "".join(parts)


def _in_words(name: str, values: Array, unit: str) -> str:
    known = values[~np.isnan(values)]
    low, middle, high = (f"{v:.3g}" for v in (known.min(), np.median(known), known.max()))
    return f"{name}: {low} to {high} {unit}, median {middle}".replace("  ", " ")


def _short(value: float, among: Sequence[float]) -> str:
    """A tick's label, with as many decimals as the tick step needs."""
    step = abs(among[1] - among[0]) if len(among) > 1 else abs(value) or 1.0
    if max(abs(v) for v in among) >= 1e5 or step < 1e-4:
        return f"{value:.3g}"
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{value:.{decimals}f}".replace("-", "−")


def band(states: Sequence[str]) -> tuple[Stretch, ...]:
    """Runs of equal states, consecutive along 0 to 1."""
    cuts = [0, *(k for k in range(1, len(states)) if states[k] != states[k - 1]), len(states)]
    return tuple(Stretch(states[a], a / len(states), (b - a) / len(states)) for a, b in pairwise(cuts) if b > a)


def arrow_field(
    centres_px: Array, angle_rad: Array, length_px: Array, width: int, height: int
) -> ArrowField:  # fmt: skip
    """Arrows along the blur of each tile, centred on it, in the direction of image motion: angle with x right, y down.

    centres_px: (n, 2).  Enlarged by one of ARROW_SCALES so that the longest arrow nearly reaches the next one.
    """
    known = (np.abs(np.column_stack([centres_px, angle_rad, length_px])) < ABSURD).all(axis=1)
    centres_px, angle_rad, length_px = centres_px[known], angle_rad[known], length_px[known]
    keep = _thinned_tiles(centres_px)
    centres, angles, lengths = centres_px[keep], angle_rad[keep], length_px[keep]
    if not len(lengths) or not lengths.max() > 0:
        return ArrowField((), 1)
    distance = math.sqrt(width * height / len(lengths))
    fitting = [scale for scale in ARROW_SCALES if scale * float(lengths.max()) <= ARROW_REACH * distance]
    scale = fitting[-1] if fitting else 1
    longest_head = HEAD_MAX * math.hypot(width, height)
    shafts = scale * lengths[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return ArrowField(
        tuple(_arrow(c - s / 2, c + s / 2, a, longest_head) for c, s, a in zip(centres, shafts, angles, strict=True)),
        scale,
    )


def _thinned_tiles(centres_px: Array) -> Mask:
    """Every k-th row and column of tiles, so that at most MAX_ARROWS are left."""
    columns = np.unique(centres_px[:, 0], return_inverse=True)[1] if len(centres_px) else np.zeros(0, int)
    rows = np.unique(centres_px[:, 1], return_inverse=True)[1] if len(centres_px) else np.zeros(0, int)
    keep = np.ones(len(centres_px), bool)
    step = 1
    while keep.sum() > MAX_ARROWS:
        step += 1
        keep = np.logical_and(*(k % step == min(step // 2, int(k.max()) // 2) for k in (columns, rows)))
    return keep


def _arrow(tail: Array, tip: Array, angle: float, longest_head: float) -> Arrow:
    head = min(HEAD_PART * float(np.hypot(*(tip - tail))), longest_head)
    wings = [tip - head * np.array([math.cos(angle + s), math.sin(angle + s)]) for s in (HEAD_RAD, -HEAD_RAD)]
    points = [f"{p[0]:.1f} {p[1]:.1f}" for p in (tail, tip, *wings)]
    return Arrow(f"M{points[0]}L{points[1]}M{points[2]}L{points[1]}L{points[3]}")
