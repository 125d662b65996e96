"""Scenes: a radiance chart on a plane, at infinity or at a finite depth.

A chart is linear light, float32 RGB; 1 is the clip level of a response curve that ends at 1.  It is drawn at a higher
resolution than the frame and blurred once by lens and pixel (a Gaussian of LENS_SIGMA_PX frame pixels: contrast 0.29 at
the frame's Nyquist frequency), so one interpolated sample per pixel renders an instant without aliasing.

Dead leaves: occluding discs, ellipses and polygons with radii distributed as r⁻³, which reproduces the scale invariance
of natural images (Lee, Mumford & Huang 2001, doi:10.1023/A:1011109015675), with 1/f texture and shading inside each.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.errors import SettingsError

log = logging.getLogger(__name__)

KINDS = ("leaves", "colours", "bright", "board", "text", "photographs")
LENS_SIGMA_PX = 0.5
"""Blur of lens and pixel, contrast 0.29 at the Nyquist frequency: pixels of 1.2 µm behind a diffraction-limited f/1.8
leave 0.31 at 0.55 µm, 0.64 for the pixel's aperture times 0.49 for diffraction."""
MAX_CHART_PX = 36_000_000
"""0.4 GB as 32-bit RGB."""
PHOTOGRAPHS = ("astronaut", "chelsea", "coffee", "rocket")
"""Colour photographs in scikit-image: a portrait, fur, a table, a rocket at night."""
HORIZON = np.float32(1e-3)
"""Least denominator of the map from rays to the chart: rays along its plane, or away from it, meet no point of it."""
_TEXTURE_SIDE = 512
"""All leaves cut their texture from one periodic picture: larger than a leaf, and fast to transform."""
_TEXT = (
    "the quick brown fox jumps over the lazy dog",
    "restored frames keep the lens, undo the hand",
    "rows are read one by one, right to left",
    "0123456789 +-*/= (a, b) [c] {d} <e> #f",
    "sphinx of black quartz, judge my vow",
    "five dozen liquor jugs packed in my box",
)


@dataclass(frozen=True, slots=True)
class Scene:
    """A chart on a plane.

    The plane passes through (0, 0, depth_m), world axes, with the given normal.  The chart's x axis is the world's,
    projected into the plane; its y axis completes the right-handed frame.  With infinite ``depth_m`` only directions
    matter: the plane z = 1 seen from the origin.
    """

    chart: NDArray[Any]
    """(rows, columns, 3) linear light."""
    chart_focal_px: float
    """Chart focal length: chart pixels per unit of x/z at the chart's centre."""
    depth_m: float = np.inf
    """Distance of the plane along the world's z axis."""
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit normal of the plane, world axes."""
    drift_per_s: tuple[float, float] = (0.0, 0.0)
    """Velocity of the chart along its x and y axes, units of x/z per second."""

    @property
    def fastest_per_s(self) -> float:
        """Maximum speed of scene motion, units of x/z per second."""
        return float(np.hypot(*self.drift_per_s))

    def chart_from_ray(
        self,
        rotation_world_cam: Array,
        position_m: Array,
        time_s: Array | float = 0.0,
    ) -> Array:
        """Homography from rays (x, y, 1) in camera axes to homogeneous chart pixels, for poses (..., 3, 3), (..., 3).

        time_s: (...,) time of each pose; it matters only if the chart moves.

        A ray d from p meets the plane n·X = n·X0 at ``X = p + d n·(X0 − p)/(n·d)``, linear in d up to the division.
        """
        rotation = np.asarray(rotation_world_cam, float)
        position = np.asarray(position_m, float)
        if np.isinf(self.depth_m):
            plane = np.broadcast_to(np.eye(3), rotation.shape)
        else:
            n = np.array(self.normal)
            e1 = _unit(np.array([1.0, 0, 0]) - n[0] * n)
            e2 = np.cross(n, e1)
            offset = position - np.array([0, 0, self.depth_m])
            distance = -(offset @ n)
            rows = [distance[..., None] * e + (offset @ e)[..., None] * n for e in (e1, e2)]
            plane = np.stack([rows[0], rows[1], np.broadcast_to(n * self.depth_m, rows[0].shape)], axis=-2)
        return self._chart_matrix(np.asarray(time_s, float)) @ plane @ rotation

    def _chart_matrix(self, time_s: Array) -> Array:
        height, width = self.chart.shape[:2]
        focal = self.chart_focal_px
        matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
        if not any(self.drift_per_s):
            return matrix
        matrices = np.broadcast_to(matrix, (*time_s.shape, 3, 3)).copy()
        matrices[..., :2, 2] -= focal * time_s[..., None] * np.array(self.drift_per_s)
        return matrices

    def at_plane(self, depth_m: float, normal: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Scene:
        """Move the chart to a plane at another depth; its angular size at the origin is unchanged."""
        return Scene(self.chart, self.chart_focal_px, depth_m, normal, self.drift_per_s)

    def sample(self, homography: Array, x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
        """Light along rays (x, y, 1), bilinear between chart pixels, mirrored outside: (h, w, channels).

        Rays that miss the chart's plane see its horizon.
        """
        h = homography.astype(np.float32)
        weight = 1.0 / np.maximum(h[2, 0] * x + (h[2, 1] * y + h[2, 2]), HORIZON)
        map_x = h[0, 0] * x + (h[0, 1] * y + h[0, 2])
        map_y = h[1, 0] * x + (h[1, 1] * y + h[1, 2])
        map_x *= weight
        map_y *= weight
        return cv2.remap(self.chart, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


@dataclass(frozen=True, slots=True)
class ReliefScene(Scene):
    """A chart with objects in front: several planes, each occluding those listed before it.

    Homographies are stacked (..., planes, 3, 3), background first.
    """

    nearer: tuple[Scene, ...] = ()
    """Planes in front, back to front; their charts hold light × opacity in channels 0 to 2 and opacity in channel 3."""

    @property
    def fastest_per_s(self) -> float:
        """Maximum speed of scene motion, units of x/z per second."""
        return max(float(np.hypot(*plane.drift_per_s)) for plane in (self, *self.nearer))

    def chart_from_ray(
        self,
        rotation_world_cam: Array,
        position_m: Array,
        time_s: Array | float = 0.0,
    ) -> Array:
        """Homographies of all planes, as :meth:`Scene.chart_from_ray`: (..., planes, 3, 3)."""
        farthest = Scene(self.chart, self.chart_focal_px, self.depth_m, self.normal, self.drift_per_s)
        planes = (farthest, *self.nearer)
        return np.stack([p.chart_from_ray(rotation_world_cam, position_m, time_s) for p in planes], axis=-3)

    def sample(self, homography: Array, x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
        """Light along rays, the planes composited back to front: (h, w, 3)."""
        light = Scene.sample(self, homography[0], x, y)
        for plane, plane_homography in zip(self.nearer, homography[1:], strict=True):
            layer = plane.sample(plane_homography, x, y)
            light = light * (1 - layer[..., 3:]) + layer[..., :3]
        return light


def add_near_objects(
    scene: Scene,
    rng: np.random.Generator,
    *,
    depth_m: float,
    focal_px: float,
    objects: int = 14,
    size: float = 0.13,
    drift_per_s: tuple[float, float] = (0.0, 0.0),
) -> ReliefScene:
    """Add discs, ellipses and polygons with dead-leaves texture on a nearer plane z = depth_m.

    focal_px: the camera's, as for :func:`make_scene`.  size: mean radius in units of x/z, seen from the origin.
    drift_per_s: their common velocity.
    """
    height, width = scene.chart.shape[:2]
    oversampling = scene.chart_focal_px / focal_px
    opacity = np.zeros((height, width), np.float32)
    for _ in range(objects):
        centre = rng.uniform((0, 0), (width, height))
        _fill_leaf(opacity, rng, centre, float(rng.uniform(0.5, 1.5)) * size * scene.chart_focal_px, 1.0)
    drawing = _draw_leaves(rng, width, height, oversampling)
    layers = np.dstack([drawing * opacity[..., None], opacity])
    layers = cv2.GaussianBlur(layers, (0, 0), LENS_SIGMA_PX * oversampling, borderType=cv2.BORDER_REFLECT)
    near = Scene(layers, scene.chart_focal_px, depth_m, drift_per_s=drift_per_s)
    others = scene.nearer if isinstance(scene, ReliefScene) else ()
    return ReliefScene(
        scene.chart, scene.chart_focal_px, scene.depth_m, scene.normal, scene.drift_per_s, (*others, near)
    )


MOVING_LAYERS, MOVING_OBJECTS, MOVING_SIZE = 3, 4, 0.09
"""Planes of moving objects, objects per plane, mean radius in units of x/z; together about 20 % of the frame."""


def add_moving_objects(scene: Scene, rng: np.random.Generator, *, speed_px_s: float, focal_px: float) -> ReliefScene:
    """Add planes of objects at the scene's depth that move across it, each plane in its own direction.

    speed_px_s: mean speed in the image of a stationary camera of focal length focal_px; each plane's is within ±30 %.
    """
    first = rng.uniform(0, 2 * np.pi)
    for layer in range(MOVING_LAYERS):
        angle = first + 2 * np.pi * layer / MOVING_LAYERS
        speed = speed_px_s / focal_px * float(rng.uniform(0.7, 1.3))
        drift = (speed * float(np.cos(angle)), speed * float(np.sin(angle)))
        scene = add_near_objects(
            scene, rng, depth_m=scene.depth_m, focal_px=focal_px, objects=MOVING_OBJECTS, size=MOVING_SIZE,
            drift_per_s=drift,
        )  # fmt: skip
    assert isinstance(scene, ReliefScene)
    return scene


def make_scene(
    kind: str,
    rng: np.random.Generator,
    *,
    focal_px: float,
    half_extent: tuple[float, float] = (1.0, 1.0),
    depth_m: float = np.inf,
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0),
    oversampling: float = 2.0,
    lens_sigma_px: float = LENS_SIGMA_PX,
) -> Scene:
    """Draw a scene of one of KINDS for a camera of focal length ``focal_px``.

    half_extent: range of x/z and y/z on each side of the chart's centre.  oversampling: chart pixels per frame pixel at
    the centre; reduced (with a log message) if the chart would exceed MAX_CHART_PX.  lens_sigma_px: blur of lens and
    pixel, in frame pixels of that camera.
    """
    if kind not in KINDS:
        raise SettingsError(f"scene '{kind}' is not known", hint=f"use one of {', '.join(KINDS)}")
    area = 4 * half_extent[0] * half_extent[1] * focal_px**2
    finest = float(np.sqrt(MAX_CHART_PX / area))
    if finest < oversampling:
        log.warning("scene chart limited to %.2f chart pixels per picture pixel", finest)
        oversampling = finest
    chart_focal = focal_px * oversampling
    width, height = (2 * int(np.ceil(extent * chart_focal)) for extent in half_extent)
    drawing = _DRAWINGS[kind](rng, width, height, oversampling)
    sigma = lens_sigma_px * oversampling
    chart = cv2.GaussianBlur(drawing, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
    return Scene(chart, chart_focal, depth_m, normal)


# ── drawings: linear light, (height, width, 3) float32, not yet blurred ────────────────────────────────────────────


def _draw_leaves(rng: np.random.Generator, width: int, height: int, scale: float) -> NDArray[Any]:
    """Dead leaves with texture and shading, clipped to 0.004 … 0.9."""
    labels, count = _leaf_labels(rng, width, height, scale)
    colour = _natural_colours(rng, count)
    return np.clip(_textured(rng, labels, colour), 0.004, 0.9)


def _draw_colours(rng: np.random.Generator, width: int, height: int, scale: float) -> NDArray[Any]:
    """Dead leaves of saturated colours: print, toys, clothes."""
    labels, count = _leaf_labels(rng, width, height, scale)
    return np.clip(_textured(rng, labels, _saturated_colours(rng, count)), 0.004, 0.9)


def _draw_bright(rng: np.random.Generator, width: int, height: int, scale: float) -> NDArray[Any]:
    """Dead leaves with highlights of 1.5 to 12 times the clip level on about 3 % of the area."""
    light = _draw_leaves(rng, width, height, scale)
    target, covered, tries = 0.03 * width * height, 0.0, 0
    while covered < target and tries < 20_000:
        tries += 1
        radius = float(_power_radii(rng, 1, 2.5 * scale, 0.02 * min(width, height) + 4 * scale)[0])
        centre = rng.uniform((0, 0), (width, height))
        colour = rng.uniform(2.0, 12.0) * rng.uniform(0.75, 1.0, 3)
        _fill_leaf(light, rng, centre, radius, tuple(map(float, colour)))
        covered += np.pi * radius**2
    return light


def _draw_board(rng: np.random.Generator, width: int, height: int, scale: float) -> NDArray[Any]:
    """Chessboard on a white sheet before a grey wall, with AprilTag-like codes in the white squares."""
    light = np.full((height, width, 3), 0.25, np.float32)
    columns, rows = (7, 10) if height >= width else (10, 7)
    side = int(0.55 * min(width / columns, height / rows))
    left, top = (width - columns * side) // 2, (height - rows * side) // 2
    margin = side
    light[max(top - margin, 0) : top + rows * side + margin, max(left - margin, 0) : left + columns * side + margin] = (
        0.8
    )
    for row in range(rows):
        for column in range(columns):
            y, x = top + row * side, left + column * side
            if (row + column) % 2 == 0:
                light[y : y + side, x : x + side] = 0.03
            else:
                _draw_tag(light, rng, x + side // 5, y + side // 5, 3 * side // 5)
    return light * np.array([1.0, 0.98, 0.94], np.float32)


def _draw_tag(light: NDArray[Any], rng: np.random.Generator, x: int, y: int, side: int) -> None:
    """Draw a square code of 6 × 6 black and white cells with a black border."""
    cell = max(side // 8, 1)
    light[y : y + 8 * cell, x : x + 8 * cell] = 0.03
    bits = rng.integers(0, 2, (6, 6))
    for row, column in np.argwhere(bits):
        top, left = y + (row + 1) * cell, x + (column + 1) * cell
        light[top : top + cell, left : left + cell] = 0.8


def _draw_text(rng: np.random.Generator, width: int, height: int, scale: float) -> NDArray[Any]:
    """Printed page: dark text of several sizes on off-white paper with slowly varying shading."""
    ink = np.zeros((height, width), np.uint8)
    y = int(20 * scale)
    while y < height + 10:
        size = scale * float(rng.choice([0.4, 0.55, 0.8, 1.2, 2.0], p=[0.2, 0.3, 0.25, 0.15, 0.1]))
        x = int(rng.uniform(-200, 0) * scale)
        while x < width:
            line = str(rng.choice(_TEXT))
            face = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_DUPLEX]))
            thick = max(1, round(size * 1.3))
            (length, tall), _ = cv2.getTextSize(line, face, size, thick)
            cv2.putText(ink, line, (x, y), face, size, 255, thick, cv2.LINE_AA)
            x += length + int(30 * scale)
        y += int(tall * 2.0 + 6 * scale)
    grey = 0.72 - np.float32(0.68 / 255) * ink
    shade = 1 + 0.15 * _smooth_field(rng, width, height)
    tint = np.array([1.0, 0.97, 0.9], np.float32)
    return np.clip(grey * shade, 0.004, 0.9)[..., None] * tint


def _draw_photographs(rng: np.random.Generator, width: int, height: int, scale: float) -> NDArray[Any]:
    """Photographs tiled in rows, one photograph pixel per frame pixel; their colour and brightness are correlated."""
    try:
        from skimage import data
    except ImportError:
        raise SettingsError(
            "scene 'photographs' is made of scikit-image's, which is not installed", hint="pip install scikit-image"
        ) from None
    pictures = [getattr(data, name)() for name in PHOTOGRAPHS]
    wide, tall = int(np.ceil(width / scale)), int(np.ceil(height / scale))
    grey, top = np.empty((tall, wide, 3), np.uint8), 0
    while top < tall:
        in_row, filled = [], 0
        while filled < wide:
            in_row.append(pictures[rng.integers(len(pictures))])
            filled += in_row[-1].shape[1]
        rows = min(min(len(picture) for picture in in_row), tall - top)
        grey[top : top + rows] = np.hstack([picture[:rows] for picture in in_row])[:, :wide]
        top += rows
    light = _SRGB_LIGHT[cv2.resize(grey, (width, height), interpolation=cv2.INTER_CUBIC)]
    return np.clip(0.9 * light, 0.004, 0.9)


_SRGB_LIGHT = np.where(
    np.arange(256) <= 10, np.arange(256) / 255 / 12.92, ((np.arange(256) / 255 + 0.055) / 1.055) ** 2.4
).astype(np.float32)
"""Linear light of each 8-bit sRGB level (IEC 61966-2-1)."""
_DRAWINGS = {
    "leaves": _draw_leaves,
    "colours": _draw_colours,
    "bright": _draw_bright,
    "board": _draw_board,
    "text": _draw_text,
    "photographs": _draw_photographs,
}


# ── dead leaves ────────────────────────────────────────────────────────────────────────────────────────────────────


def _leaf_labels(rng: np.random.Generator, width: int, height: int, scale: float) -> tuple[NDArray[np.int32], int]:
    """Topmost leaf at each chart pixel (0: background), and the number of labels."""
    small, large = 4.5 * scale, 0.25 * min(width, height) + 5 * scale
    mean_area = 2 * np.pi * small**2 * np.log(large / small) / (1 - (small / large) ** 2)
    count = int(min(4.0 * width * height / mean_area, 150_000))
    radii = _power_radii(rng, count, small, large)
    centres = rng.uniform((-0.5 * large, -0.5 * large), (width + 0.5 * large, height + 0.5 * large), (count, 2))
    labels = np.zeros((height, width), np.int32)
    for leaf, (centre, radius) in enumerate(zip(centres, radii.tolist(), strict=True), start=1):
        _fill_leaf(labels, rng, centre, radius, leaf)
    return labels, count + 1


def _power_radii(rng: np.random.Generator, count: int, small: float, large: float) -> Array:
    """Radii with density ∝ r⁻³ between small and large."""
    u = rng.uniform(size=count)
    return 1.0 / np.sqrt((1 - u) / small**2 + u / large**2)


def _fill_leaf(canvas: NDArray[Any], rng: np.random.Generator, centre: NDArray[Any], radius: float, value: Any) -> None:
    """Fill a random disc, ellipse or polygon, coordinates to 1/16 pixel."""
    shape, angle, aspect = rng.uniform(size=3)
    at = (int(centre[0] * 16), int(centre[1] * 16))
    if shape < 0.35:
        cv2.circle(canvas, at, max(int(radius * 16), 8), value, -1, cv2.LINE_8, 4)
        return
    if shape < 0.7:
        axes = (max(int(radius * 16), 8), max(int(radius * (0.35 + 0.65 * aspect) * 16), 8))
        cv2.ellipse(canvas, at, axes, angle * 180, 0, 360, value, -1, cv2.LINE_8, 4)
        return
    corners = 3 + int(aspect * 4)
    turn = 2 * np.pi * (angle + (np.arange(corners) + 0.5 * rng.uniform(size=corners)) / corners)
    points = 16 * (np.asarray(centre) + 1.15 * radius * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    cv2.fillPoly(canvas, [points.astype(np.int32)], value, cv2.LINE_8, 4)


def _natural_colours(rng: np.random.Generator, count: int) -> NDArray[Any]:
    """Linear RGB (count, 3): log-normal luminance with median 0.16, muted hues along blue–yellow and red–green."""
    luminance = np.clip(0.16 * np.exp(rng.normal(0, 0.7, count)), 0.012, 0.8)
    yellow, red = rng.normal(0, 0.22, count), rng.normal(0, 0.09, count)
    tint = np.exp(np.stack([0.5 * yellow + red, 0.15 * yellow - 0.5 * red, -yellow], axis=1))
    return (luminance[:, None] * tint).astype(np.float32)


def _saturated_colours(rng: np.random.Generator, count: int) -> NDArray[Any]:
    """Linear RGB (count, 3): channels independent and even over the grey levels of sRGB, as of printed inks."""
    return _SRGB_LIGHT[rng.integers(10, 246, (count, 3))]


def _textured(rng: np.random.Generator, labels: NDArray[np.int32], colour: NDArray[Any]) -> NDArray[Any]:
    """Each leaf's colour times its own crop of a 1/f texture, times a smooth shading field over the chart."""
    height, width = labels.shape
    texture = _one_over_f(rng, _TEXTURE_SIDE)
    strength = (rng.gamma(2.0, 0.07, len(colour))).astype(np.float32)
    down, right = rng.integers(0, _TEXTURE_SIDE, (2, len(colour)), dtype=np.int32)
    shade = np.exp(0.25 * _smooth_field(rng, width, height))
    light = np.empty((height, width, 3), np.float32)
    columns = np.arange(width, dtype=np.int32)
    for top in range(0, height, 256):
        leaf = labels[top : top + 256]
        rows = np.arange(top, top + leaf.shape[0], dtype=np.int32)[:, None]
        index = (rows + down[leaf]) % _TEXTURE_SIDE * _TEXTURE_SIDE + (columns + right[leaf]) % _TEXTURE_SIDE
        crop = texture.take(index)
        factor = np.exp(strength.take(leaf) * crop) * shade[top : top + 256]
        light[top : top + 256] = colour.take(leaf, axis=0) * factor[..., None]
    return light


def _one_over_f(rng: np.random.Generator, side: int) -> NDArray[Any]:
    """Periodic texture with a 1/f amplitude spectrum, mean 0, standard deviation 1: (side, side)."""
    fy, fx = np.meshgrid(np.fft.fftfreq(side), np.fft.rfftfreq(side), indexing="ij")
    radius = np.hypot(fx, fy)
    radius[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(side, side))) / np.maximum(radius, 4 / side)
    field = np.fft.irfft2(spectrum, s=(side, side))
    return (field / field.std()).astype(np.float32)


def _smooth_field(rng: np.random.Generator, width: int, height: int) -> NDArray[Any]:
    """Smooth random field over the chart, of about unit amplitude."""
    coarse = rng.normal(size=(6, 6)).astype(np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)
