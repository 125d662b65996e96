"""``virest evaluate deblur``: frames restored by several methods against ground truth (the paper's Case B, Table 1)."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from virest.app.console import numeric_table
from virest.app.difference_sheets import amplified_difference, labelled, write_sheet
from virest.app.evaluation_captures import TrueCapture, open_true_capture, peer_versions, read_picture, temporary_folder
from virest.app.simulate import simulate_command
from virest.arrays import Array, Picture
from virest.camera.response import ResponseCurve
from virest.capture.pixels import luma_of
from virest.errors import CaptureError
from virest.evaluation.baselines import BASELINES, baseline_pictures
from virest.evaluation.burst import BURSTS, REACHES, align_frames
from virest.evaluation.fidelity import (
    MARGIN_PX,
    fidelity,
    inner_part,
    mean_squared_error,
    psnr_of,
    shift_px,
)
from virest.evaluation.matching import METHOD, count_matches
from virest.image_formation.row_motion import RowMotion
from virest.motion.optics import moving_lens
from virest.restoration.settings import PRESETS, RestorationSettings

Progress = Callable[[str, float], Any]
BLURRED = "blurred"
CASE = "B: motion blur"
CASE_OVER_TIME = "B over time: motion blur, frames with their neighbours"
OURS = tuple(f"virest {preset}" for preset in PRESETS)
SIZE: dict[str, Any] = {"width": 640, "height": 480}
STANDARD: tuple[tuple[str, dict[str, Any]], ...] = (
    ("leaves", SIZE | {"scene": "leaves", "exposure_ms": 16.0, "rate_rad_s": 1.4, "noise_levels": 1.5, "seed": 51}),
    ("text", SIZE | {"scene": "text", "exposure_ms": 16.0, "rate_rad_s": 1.4, "noise_levels": 2.0, "seed": 52}),
    ("board", SIZE | {"scene": "board", "exposure_ms": 16.0, "rate_rad_s": 1.4, "noise_levels": 2.5, "seed": 53}),
)
QUICK = ("leaves", "text")
FRAMES, FRAMES_QUICK = 4, 2
"""Frames of each standard capture: every method restores each, slow ones with several settings."""
MERGED: dict[str, Any] = SIZE | {"exposure_ms": 18.0, "frames": 11}
OVER_TIME: tuple[tuple[str, dict[str, Any]], ...] = (
    ("shake", MERGED | {"scene": "leaves", "rate_rad_s": 1.6, "noise_levels": 3.0, "seed": 61}),
    ("pan", MERGED | {"scene": "photographs", "rate_rad_s": 0.4, "pan_rad_s": 1.2, "seed": 62}),
    ("walk", MERGED | {"rate_rad_s": 1.2, "depth_m": 1.8, "near_m": 1.1, "sway_m": 0.03, "seed": 63}),
    ("moving", MERGED | {"rate_rad_s": 1.4, "moving_px_s": 240.0, "seed": 64}),
)
"""Captures on which frames are restored together with their neighbours."""
OVER_TIME_QUICK = ("shake", "moving")
JUDGED_OVER_TIME = slice(4, 7)
"""Of the 11 frames: those with neighbours on both sides for every method."""
SINGLE = "virest best, single"
PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
SHEET_COLUMNS = 4
"""Four frames of 640 pixels side by side: 2560 pixels."""


@dataclass(frozen=True, slots=True)
class DeblurOptions:
    """The options of one evaluation."""

    captures: tuple[str, ...] = ()
    """Empty: simulate the standard set, unless two folders are given."""
    config: Path | None = None
    frames: slice | None = None
    restored: Path | None = None
    reference: Path | None = None
    out: Path | None = None
    """Folder for difference maps."""
    quick: bool = False
    over_time: bool = False
    """Compare joint restoration with neighbouring frames to methods that merge aligned frames."""


@dataclass(frozen=True, slots=True)
class ComparedFrame:
    """One frame by every method, straightened, with its truth."""

    capture: str
    frame: str
    pictures: Mapping[str, Picture]
    """By method."""
    truth: Picture
    valid_px: Sequence[int]
    """x0, y0, x1, y1: the rectangle with recorded data."""

    @property
    def inside(self) -> tuple[slice, slice]:
        """Rows and columns to compare."""
        return inner_part(self.valid_px)


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame by one method."""

    capture: str
    frame: str
    method: str
    mse: float
    ssim: float
    matches: int
    matches_in_place: int


def run_deblur(options: DeblurOptions, progress: Progress | None = None) -> tuple[dict[str, Any], str]:
    """Evaluate captures with truth, the standard set, or two folders. Returns the facts and the text."""
    if options.restored is not None and options.reference is not None:
        return _run_folders(options, options.restored, options.reference, progress)
    results: list[FrameResult] = []
    with _chosen_captures(options) as (captures, simulated):
        total, done = sum(len(capture.frames) for capture in captures), 0
        methods = _methods_over_time if options.over_time else _all_methods
        for capture in captures:
            for compared in methods(capture):
                results += list(_measure(compared))
                _draw(options.out, f"{capture.name}-{compared.frame}", compared)
                done += 1
                if progress:
                    progress(capture.name, done / total)
    facts = _facts(results, {"simulated": simulated}, CASE_OVER_TIME if options.over_time else CASE)
    return facts, _text(facts)


@contextmanager
def _chosen_captures(options: DeblurOptions) -> Iterator[tuple[list[TrueCapture], list[dict[str, Any]]]]:
    if options.captures:
        chosen = options.frames or slice(None)
        yield [open_true_capture(Path(path), options.config, chosen) for path in options.captures], []
        return
    with temporary_folder("virest-evaluate-") as work:
        standard, quick = (OVER_TIME, OVER_TIME_QUICK) if options.over_time else (STANDARD, QUICK)
        count, judged = {"frames": FRAMES_QUICK if options.quick else FRAMES}, slice(None)
        if options.over_time:
            count, judged = {}, JUDGED_OVER_TIME
        names = [(name, settings | count) for name, settings in standard if not options.quick or name in quick]
        simulated = [{**simulate_command(work / name, **settings), "capture": name} for name, settings in names]
        yield [open_true_capture(work / name, None, judged) for name, _ in names], simulated


# ── one capture ──────────────────────────────────────────────────────────────────────────────────────────────────


def _all_methods(capture: TrueCapture) -> Iterator[ComparedFrame]:
    """Each frame by the presets and by the baselines."""
    plan = capture.plan(RestorationSettings(deblur="none"))
    plans = {BLURRED: plan} | {f"virest {name}": replace(plan, settings=preset) for name, preset in PRESETS.items()}
    curve = plan.profile.curve
    motions = capture.motions(plan)
    streams = zip(capture.recorded(), *(capture.restored(p) for p in plans.values()), strict=True)
    for (frame, recorded), *restored in streams:
        if any(r.picture is None for r in restored):
            continue
        truth, valid_px = capture.truth(frame.index), restored[-1].valid_px
        ours = {name: r.picture for name, r in zip(plans, restored, strict=True) if r.picture is not None}
        peers = _baselines(recorded, motions[frame.index], curve, truth, valid_px)
        pictures = {BLURRED: ours.pop(BLURRED), **peers, **ours}
        yield ComparedFrame(capture.name, f"{frame.index:06d}", pictures, truth, valid_px)


def _methods_over_time(capture: TrueCapture) -> Iterator[ComparedFrame]:
    """As :func:`_all_methods`, for methods that merge aligned frames, and ours without and with neighbours."""
    plan = capture.plan(RestorationSettings(deblur="none"))
    settings = {SINGLE: replace(PRESETS["best"], neighbours=0)} | {
        f"virest {name}": PRESETS[name] for name in ("balanced", "best")
    }
    plans = {BLURRED: plan} | {name: capture.plan(chosen) for name, chosen in settings.items()}
    motions, trajectory = capture.motions(plan), capture.trajectory(plan)
    lens = moving_lens(trajectory, plan.profile)
    pictures = {frame.index: picture for frame, picture in capture.recorded(max(REACHES))}
    for restored in zip(*(capture.restored(p) for p in plans.values()), strict=True):
        number = restored[0].frame.index
        if any(r.picture is None for r in restored):
            continue
        truth, valid_px = capture.truth(number), restored[-1].valid_px
        inside = inner_part(valid_px)
        near = [(n, p) for n, p in pictures.items() if abs(n - number) <= max(REACHES)]
        aligned = align_frames(near, number, motions, trajectory, lens)
        merged = {name: _closest(merge(aligned), truth, inside) for name, merge in BURSTS.items()}
        ours = {name: r.picture for name, r in zip(plans, restored, strict=True) if r.picture is not None}
        pictures_by_method = {BLURRED: ours.pop(BLURRED), **merged, **ours}
        yield ComparedFrame(capture.name, f"{number:06d}", pictures_by_method, truth, valid_px)


def _closest(pictures: Iterable[Picture], truth: Picture, inside: tuple[slice, slice]) -> Picture:
    """The picture with the smallest squared error against truth."""
    return min(pictures, key=lambda picture: mean_squared_error(picture[inside], truth[inside]))


def _baselines(
    recorded: Picture, motion: RowMotion, curve: ResponseCurve, truth: Picture, valid_px: Sequence[int]
) -> dict[str, Picture]:
    """Each baseline's best picture by squared error against truth; baselines without their library are skipped."""
    inside = inner_part(valid_px)
    return {
        name: _closest(baseline_pictures(baseline, recorded, motion, curve), truth, inside)
        for name, baseline in BASELINES.items()
        if baseline.available
    }


def _measure(compared: ComparedFrame) -> Iterator[FrameResult]:
    truth = compared.truth[compared.inside]
    for method, whole in compared.pictures.items():
        picture = whole[compared.inside]
        close, alike = fidelity(picture, truth), count_matches(picture, truth)
        yield FrameResult(compared.capture, compared.frame, method, close.mse, close.ssim, alike.good, alike.in_place)


def _draw(out: Path | None, name: str, compared: ComparedFrame) -> None:
    """Write the pictures above their difference maps, truth first, SHEET_COLUMNS per row."""
    if out is None:
        return
    truth = compared.truth[compared.inside]
    shown = {"truth": truth} | {method: picture[compared.inside] for method, picture in compared.pictures.items()}
    cells = [
        labelled(method, np.concatenate([picture, amplified_difference(picture, truth)]))
        for method, picture in shown.items()
    ]
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % SHEET_COLUMNS)
    rows = [np.concatenate(cells[k : k + SHEET_COLUMNS], axis=1) for k in range(0, len(cells), SHEET_COLUMNS)]
    write_sheet(out / f"{name}-difference.png", np.concatenate(rows))


# ── two folders ──────────────────────────────────────────────────────────────────────────────────────────────────


def _run_folders(
    options: DeblurOptions, restored: Path, reference: Path, progress: Progress | None
) -> tuple[dict[str, Any], str]:
    """Compare pictures of the same name, each aligned to its reference and both cropped to their overlap."""
    names = _common_names(restored, reference)
    results, shifts = [], {}
    real_px = _valid_areas(restored.parent / "parameters.jsonl")
    for position, name in enumerate(names):
        picture, truth = read_picture(restored / name), read_picture(reference / name)
        if picture.shape != truth.shape:
            raise CaptureError(f"{name}: {_size(picture)} in {restored}, {_size(truth)} in {reference}",
                               hint="give pictures of the same size")  # fmt: skip
        aligned, shift, shared_px = _aligned(picture, truth)
        shared_px = _common(shared_px, real_px.get(name, shared_px))
        shifts[name] = {"shift_px": [round(float(s), 4) for s in shift], "compared_px": list(shared_px)}
        compared = ComparedFrame(restored.name, name, {"restored": aligned}, truth, shared_px)
        results += list(_measure(compared))
        _draw(options.out, Path(name).stem, compared)
        if progress:
            progress(name, (position + 1) / len(names))
    facts = _facts(results, {"restored": str(restored), "reference": str(reference), "pictures": shifts})
    return facts, _text(facts)


def _common_names(restored: Path, reference: Path) -> list[str]:
    for folder in (restored, reference):
        if not folder.is_dir():
            raise CaptureError(f"{folder}: no such folder", hint="give two folders with pictures of the same names")
    there = {p.name for p in reference.iterdir()}
    names = sorted(p.name for p in restored.iterdir() if p.suffix.lower() in PICTURE_ENDINGS and p.name in there)
    if not names:
        raise CaptureError(
            f"{restored} and {reference} have no file name in common", hint="name pairs alike: 000017.png"
        )
    return names


def _valid_areas(log: Path) -> dict[str, tuple[int, ...]]:
    """valid_px of each picture if the folder belongs to a ``virest process`` run; outside it the edge is replicated."""
    if not log.is_file():
        return {}
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    return {Path(line["output"]).name: tuple(line["valid_px"]) for line in lines if line["output"]}


def _common(first: Sequence[int], second: Sequence[int]) -> tuple[int, int, int, int]:
    """The rectangle that two rectangles share."""
    (x0, y0, x1, y1), (u0, v0, u1, v1) = first, second
    return max(x0, u0), max(y0, v0), min(x1, u1), min(y1, v1)


def _size(picture: Picture) -> str:
    return f"{picture.shape[1]}x{picture.shape[0]}"


def _aligned(picture: Picture, truth: Picture) -> tuple[Picture, Array, tuple[int, int, int, int]]:
    """The picture aligned to its reference, its shift in pixels, and the rectangle that both cover.

    Whole pixels by phase correlation, the rest by least squares; cubic interpolation, none for shifts below 0.02 px.
    """
    height, width = truth.shape[:2]
    coarse = _whole_shift(picture, truth)
    margin = int(np.ceil(np.abs(coarse).max())) + MARGIN_PX
    moved = _moved(picture, coarse.astype(float))
    shift = coarse + shift_px(moved, truth, (0, 0, width, height), margin)
    if np.abs(shift).max() < 0.02:
        return picture, shift, (0, 0, width, height)
    (left, top), (right, bottom) = np.ceil(np.maximum(-shift, 0)), np.ceil(np.maximum(shift, 0))
    return _moved(picture, shift), shift, (int(left), int(top), width - int(right), height - int(bottom))


def _whole_shift(picture: Picture, truth: Picture) -> Array:
    """Shift (x, y) of the picture against its reference in whole pixels; 0 if aligning does not reduce the error."""
    grey = [luma_of(p).astype(np.float32) for p in (truth, picture)]
    window = cv2.createHanningWindow(grey[0].shape[::-1], cv2.CV_32F)
    shift = np.rint(np.array(cv2.phaseCorrelate(grey[0], grey[1], window)[0]))
    if np.abs(shift).max() > min(grey[0].shape) / 4:
        return np.zeros(2)
    inside = inner_part((0, 0, *grey[0].shape[::-1]), int(np.abs(shift).max()) + 1)
    before, after = (
        float(np.mean((_moved(picture, s)[inside].astype(float) - truth[inside]) ** 2)) for s in (np.zeros(2), shift)
    )
    return shift if after < before else np.zeros(2)


def _moved(picture: Picture, shift: Array) -> Picture:
    back = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
    size = picture.shape[1], picture.shape[0]
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(picture, back, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8)


# ── results ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _facts(results: list[FrameResult], about: dict[str, Any], case: str = CASE) -> dict[str, Any]:
    methods = list(dict.fromkeys(result.method for result in results))
    captures = list(dict.fromkeys(result.capture for result in results))
    missing = [name for name, baseline in BASELINES.items() if not baseline.available]
    return {
        "case": case,
        "versions": peer_versions(),
        "matching": METHOD,
        "margin_px": MARGIN_PX,
        "left_out": missing if len(methods) > 1 else [],
        "baselines": {name: baseline.title for name, baseline in BASELINES.items() if name in methods},
        **about,
        "frames": len({(r.capture, r.frame) for r in results}),
        "methods": _summary(results, methods),
        "by_capture": {c: _summary([r for r in results if r.capture == c], methods) for c in captures},
        "first": _first(results, methods),
        "results": [
            {"capture": r.capture, "frame": r.frame, "method": r.method, "mse": r.mse,
             "psnr_db": _finite(psnr_of(r.mse)),
             "ssim": r.ssim, "matches": r.matches, "matches_in_place": r.matches_in_place}
            for r in results
        ],
    }  # fmt: skip


def _summary(results: Sequence[FrameResult], methods: Sequence[str]) -> dict[str, Any]:
    """Means over frames, by method; PSNR is that of the mean MSE."""
    summary = {}
    for method in methods:
        own = [r for r in results if r.method == method]
        mse = float(np.mean([r.mse for r in own]))
        summary[method] = {
            "mse": mse,
            "psnr_db": _finite(psnr_of(mse)),
            "mean_frame_psnr_db": _finite(float(np.mean([psnr_of(r.mse) for r in own]))),
            "ssim": float(np.mean([r.ssim for r in own])),
            "matches": float(np.mean([r.matches for r in own])),
            "matches_in_place": float(np.mean([r.matches_in_place for r in own])),
            "frames": len(own),
        }
    return summary


def _finite(psnr_db: float) -> float | str:
    return psnr_db if np.isfinite(psnr_db) else "inf"


def _first(results: Sequence[FrameResult], methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Fraction of frames on which each preset beats all other methods in PSNR, SSIM and matches together.

    led_by: number of frames on which another method is level or ahead in one of the three.
    """
    frames: dict[tuple[str, str], dict[str, FrameResult]] = {}
    for result in results:
        frames.setdefault((result.capture, result.frame), {})[result.method] = result
    first = {}
    for ours in (method for method in OURS if method in methods):
        ahead = [
            [method for method, r in found.items() if method not in OURS and not _leads(found[ours], r)]
            for found in frames.values()
        ]
        counts = Counter(method for names in ahead for method in names)
        first[ours] = {"part": float(np.mean([not names for names in ahead])), "led_by": dict(counts.most_common())}
    return first


def _leads(own: FrameResult, other: FrameResult) -> bool:
    return own.mse < other.mse and own.ssim > other.ssim and own.matches > other.matches


def _text(facts: Mapping[str, Any]) -> str:
    header = ["method", "MSE", "PSNR dB", "SSIM", "matches", "correct"]
    parts = [
        f"CASE {facts['case'].replace(':', ',')}: {facts['frames']} frames, {facts['versions']}",
        "means over frames; PSNR of the mean MSE",
        numeric_table(header, _rows(facts["methods"])),
    ]
    if len(facts["by_capture"]) > 1:
        for name, part in facts["by_capture"].items():
            parts += [f"\n{name}: {next(iter(part.values()))['frames']} frames", numeric_table(header, _rows(part))]
    parts += ["", *_account(facts)]
    return "\n".join(parts)


def _rows(summary: Mapping[str, Any]) -> list[list[str]]:
    return [
        [method, f"{s['mse']:.1f}", s["psnr_db"] if isinstance(s["psnr_db"], str) else f"{s['psnr_db']:.2f}",
         f"{s['ssim']:.4f}", f"{s['matches']:.0f}", f"{s['matches_in_place']:.0f}"]
        for method, s in summary.items()
    ]  # fmt: skip


def _account(facts: Mapping[str, Any]) -> list[str]:
    """The data and the conditions of the measurement."""
    lines = []
    for name, found in facts["first"].items():
        led_by = ", ".join(f"{method} ({frames})" for method, frames in found["led_by"].items())
        lines.append(f"{name}: best in PSNR, SSIM and matches together on {100 * found['part']:.0f} % of the frames"
                     + (f"; matched or beaten in one of them by {led_by}" if led_by else ""))  # fmt: skip
    if "pictures" in facts:
        far = max(max(map(abs, p["shift_px"])) for p in facts["pictures"].values())
        lines.append(f"each picture aligned to its reference (by up to {far:.2f} px) and cropped to the overlap")
    lines.append(f"compared inside the valid area less a {facts['margin_px']} px border; matches: {facts['matching']}")
    if facts["baselines"]:
        lines.append(
            "baselines: true kernel of the frame centre, blended border, linear light unless noted, the same warp, "
            "the best setting for each frame by MSE against truth"
        )
        lines += [f"{name}: {title}" for name, title in facts["baselines"].items()]
    lines += [f"{name}: skipped (library not installed)" for name in facts["left_out"]]
    for s in facts.get("simulated", []):
        lines.append(f"{s['capture']}: seed {s['seed']}, {s['width']}x{s['height']}, {s['frames']} frames, exposure "
                     f"{s['exposure_ms'][0]:g} ms, readout {s['readout_ms']:g} ms, blur {s['blur_px']} px")  # fmt: skip
    return lines
