"""``virest evaluate shutter``: corner angles and images of a board against ground truth (the paper's Case A)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.console import cell, numeric_table
from virest.app.difference_sheets import amplified_difference, labelled, write_sheet
from virest.app.evaluation_captures import TrueCapture, open_true_capture, peer_versions, temporary_folder
from virest.app.outputs import require_writable
from virest.arrays import Array, Mask, Picture
from virest.capture.pixels import luma_of
from virest.capture.video import read_decodable_gray
from virest.errors import CaptureError
from virest.evaluation.angles import Rectangle, largest_rectangle, neighbour_angles_rad, quadrilateral_angles_rad
from virest.evaluation.board_scenes import BoardSetting, board_session
from virest.evaluation.boards import Board, find_board, matched, plane_lattice
from virest.evaluation.fidelity import fidelity, psnr_of
from virest.evaluation.schubert2018 import fit_velocity, velocity_map
from virest.image_formation.row_clock import ROW_MIDDLE, RowClock
from virest.inference.tracking import track_pairs
from virest.restoration.settings import RestorationSettings
from virest.restoration.shutter import warp
from virest.simulation.recording import RecordingOptions, write_recording

Progress = Callable[[str, float], Any]
METHODS: dict[str, str] = {
    "none": "as recorded",
    "schubert2018": "constant velocity from tracked points, no perspective (Schubert et al. 2018)",
    "perspective": "one homography through the four corners (the paper's)",
    "rowwise-rotation": "every row at its own time, rotation only",
    "rowwise": "every row at its own time, with translation and depth if known: what virest process does",
}
BITS_PER_PX = 2.0
"""Bit rate of the standard set's movies, high because coding noise moves corners more than straightening does."""
STANDARD = (
    BoardSetting("chessboard-far", "chessboard", seed=41),
    BoardSetting("aprilgrid-far", "aprilgrid", seed=42),
    BoardSetting("chessboard-far-portrait", "chessboard", width=480, height=640, seed=43),
    BoardSetting("chessboard-near", "chessboard", frames=45, turn_rad_s=1.0, travel_m_s=0.9, depth_m=1.3, seed=44),
    BoardSetting("aprilgrid-near", "aprilgrid", frames=45, turn_rad_s=1.2, travel_m_s=0.8, depth_m=1.1, seed=45),
)
QUICK = ("chessboard-far", "chessboard-near")
JUDGED, JUDGED_QUICK = 10, 4
"""Evenly spaced frames per capture of the standard set."""
CROP_MARGIN_PX = 12
"""Around the board's corners, for the comparison of pictures."""


@dataclass(frozen=True, slots=True)
class ShutterOptions:
    """The options of one evaluation."""

    captures: tuple[str, ...] = ()
    """Empty: simulate the standard set."""
    config: Path | None = None
    frames: slice | None = None
    board: str = "auto"
    out: Path | None = None
    """Folder for difference maps."""
    quick: bool = False


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame, all methods."""

    capture: str
    frame: int
    truth_deg: Array
    """(4,) at the board's outer corners."""
    outer_deg: Mapping[str, Array]
    """(4,) by method."""
    neighbours_deg: Mapping[str, Array]
    """(n,) differences from truth over neighbouring corners, by method."""
    detector_deg: tuple[Array, Array]
    """Errors of the corner detector on the truth picture: outer (4,), neighbouring (n,)."""
    fidelity: Mapping[str, Any]
    """By method, around the board."""


def run_shutter(options: ShutterOptions, progress: Progress | None = None) -> tuple[dict[str, Any], str]:
    """Evaluate captures with truth, or the standard set. Returns the facts and the text."""
    if options.out is not None:
        require_writable(options.out)
    results: list[FrameResult] = []
    missed: dict[str, int] = {}
    with _chosen_captures(options) as captures:
        for position, capture in enumerate(captures):
            found = list(_judge(capture, options))
            results += found
            missed[capture.name] = len(capture.frames) - len(found)
            if progress:
                progress(capture.name, (position + 1) / len(captures))
    if not results:
        raise CaptureError(
            "in no frame do all methods find the board", hint="check --board, or use virest simulate --scene board"
        )
    facts = _facts(results, missed, options)
    return facts, _text(facts)


@contextmanager
def _chosen_captures(options: ShutterOptions) -> Iterator[list[TrueCapture]]:
    if options.captures:
        yield [
            open_true_capture(Path(path), options.config, options.frames or slice(None)) for path in options.captures
        ]
        return
    with temporary_folder("virest-evaluate-") as work:
        yield [_simulated(work, setting, options.quick) for setting in _standard(options.quick)]


def _standard(quick: bool) -> list[BoardSetting]:
    return [setting for setting in STANDARD if not quick or setting.name in QUICK]


def _simulated(work: Path, setting: BoardSetting, quick: bool) -> TrueCapture:
    """Write one capture of the standard set; its profile does not state the distance of the board."""
    session = board_session(setting)
    if np.isfinite(setting.depth_m):
        session = replace(session, nominal=replace(session.nominal, depth_m=None))
    folder = write_recording(session, work / setting.name, options=RecordingOptions(bits_per_px=BITS_PER_PX))
    count = JUDGED_QUICK if quick else JUDGED
    step = max(setting.frames // (count + 1), 1)
    return open_true_capture(folder, None, slice(step, step * (count + 1), step))


# ── one capture ──────────────────────────────────────────────────────────────────────────────────────────────────


def _judge(capture: TrueCapture, options: ShutterOptions) -> Iterator[FrameResult]:
    """Frames in which the board is found in the pictures of all methods."""
    worst: tuple[float, Mapping[str, Picture], Picture] | None = None
    for number, pictures, valid_px in _straightened(capture):
        truth = capture.truth(number)
        found = _compare(capture, number, pictures, truth, valid_px, options.board)
        if found is None:
            continue
        result, crop = found
        yield result
        sheared = float(np.abs(result.outer_deg["none"] - result.truth_deg).max())
        if options.out and (worst is None or sheared > worst[0]):
            worst = sheared, {method: picture[crop] for method, picture in pictures.items()}, truth[crop]
    if worst is not None and options.out is not None:
        write_sheet(options.out / f"{capture.name}-difference.png", difference_sheet(worst[1], worst[2]))


def _straightened(capture: TrueCapture) -> Iterator[tuple[int, dict[str, Picture], tuple[int, int, int, int]]]:
    """Index, picture by every method and valid rectangle (of ours) of each evaluated frame."""
    settings = RestorationSettings(deblur="none")
    plan = capture.plan(settings)
    plans = {
        "perspective": replace(plan, settings=replace(settings, shutter="perspective")),
        "rowwise-rotation": replace(plan, translations=None),
        "rowwise": plan,
    }
    by_velocity = _by_constant_velocity(capture)
    streams = zip(capture.recorded(), *(capture.restored(p) for p in plans.values()), strict=True)
    for (frame, recorded), *restored in streams:
        straight = dict(zip(plans, (r.picture for r in restored), strict=True))
        schubert = by_velocity(frame.index, recorded)
        if schubert is None or any(picture is None for picture in straight.values()):
            continue
        pictures = {"none": recorded, "schubert2018": schubert, **straight}
        yield frame.index, {method: pictures[method] for method in METHODS}, restored[-1].valid_px


def _by_constant_velocity(capture: TrueCapture) -> Callable[[int, Picture], Picture | None]:
    """A function that straightens a frame by the velocity of its tracked points; None for too few points."""
    profile, shutter_ = capture.profile, capture.profile.shutter
    width, height = profile.width, profile.height
    exposure_s = {f.index: shutter_.true_exposure_s(f.exposure_s or 0.0) for f in capture.capture.frames}
    clock = RowClock(profile)
    middle_s = {
        f.index: float(clock.time_s(f.time_s, f.exposure_s or 0.0, exposure_share=ROW_MIDDLE))
        for f in capture.capture.frames
    }
    near = {f.index + step for f in capture.frames for step in (-1, 0, 1)} & set(middle_s)
    pairs = track_pairs(read_decodable_gray(capture.capture.movie, capture.index, sorted(near)))

    def straighten(number: int, picture: Picture) -> Picture | None:
        velocity = fit_velocity(pairs, number, middle_s, shutter_, width, height)
        if velocity is None:
            return None
        return warp(picture, velocity_map(velocity, shutter_, width, height, 0.5 * exposure_s[number]))

    return straighten


def _compare(
    capture: TrueCapture,
    number: int,
    pictures: Mapping[str, Picture],
    truth: Picture,
    valid_px: Sequence[int],
    kind: str,
) -> tuple[FrameResult, tuple[slice, slice]] | None:
    """Angles and pictures of one frame, and the part of the picture around the board."""
    board = find_board(luma_of(truth), kind)
    if board is None:
        return None
    lattices = {m: matched(find_board(luma_of(picture), board.kind), board) for m, picture in pictures.items()}
    everywhere = np.asarray(np.isfinite(np.stack([board.points_px, *lattices.values()])).all((0, -1)))
    rectangle = largest_rectangle(everywhere)
    crop = _around(board, valid_px)
    if rectangle is None or crop is None:
        return None
    plane = plane_lattice(board, capture.profile.intrinsics)
    neighbours = {m: _neighbour_errors_deg(lattice, board.points_px, everywhere) for m, lattice in lattices.items()}
    truth_deg = _outer_deg(board.points_px, rectangle)
    own = _outer_deg(plane, rectangle) - truth_deg, _neighbour_errors_deg(plane, board.points_px, everywhere)
    outer = {m: _outer_deg(lattice, rectangle) for m, lattice in lattices.items()}
    closeness = {m: fidelity(picture[crop], truth[crop]) for m, picture in pictures.items()}
    return FrameResult(capture.name, number, truth_deg, outer, neighbours, own, closeness), crop


def _outer_deg(lattice: Array, rectangle: Rectangle) -> Array:
    return np.degrees(quadrilateral_angles_rad(rectangle.corners(lattice)))


def _neighbour_errors_deg(lattice: Array, truth: Array, everywhere: Mask) -> Array:
    """Differences (n,) over the corners that all methods have."""
    shown, true = (np.where(everywhere[..., None], points, np.nan) for points in (lattice, truth))
    errors = np.degrees(neighbour_angles_rad(shown) - neighbour_angles_rad(true))
    return errors[np.isfinite(errors)]


def _around(board: Board, valid_px: Sequence[int]) -> tuple[slice, slice] | None:
    """Rows and columns around the board inside the valid area; None: too few."""
    x0, y0, x1, y1 = board.box_px()
    left, top = (int(max(v - CROP_MARGIN_PX, low)) for v, low in zip((x0, y0), valid_px[:2], strict=True))
    right, bottom = (int(min(v + CROP_MARGIN_PX, high)) for v, high in zip((x1, y1), valid_px[2:], strict=True))
    return (slice(top, bottom), slice(left, right)) if min(right - left, bottom - top) > 4 * CROP_MARGIN_PX else None


def difference_sheet(pictures: Mapping[str, Picture], truth: Picture) -> Picture:
    """Truth and the difference maps of all methods side by side, each labelled; RGB."""
    shown = {"truth": truth} | {method: amplified_difference(picture, truth) for method, picture in pictures.items()}
    return np.concatenate([labelled(name, picture) for name, picture in shown.items()], axis=1)


# ── results ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _facts(results: list[FrameResult], missed: dict[str, int], options: ShutterOptions) -> dict[str, Any]:
    names = list(dict.fromkeys(result.capture for result in results))
    parts = {name: [r for r in results if r.capture == name] for name in names}
    simulated = [] if options.captures else [asdict(setting) for setting in _standard(options.quick)]
    return {
        "case": "A: rolling shutter",
        "methods": METHODS,
        "versions": peer_versions(),
        "frames": len(results),
        "captures": {name: {"frames": len(parts[name]), "without_board": missed[name]} for name in names},
        "simulated": simulated,
        "simulated_bits_per_px": None if options.captures else BITS_PER_PX,
        "example": _example(results),
        "all": _summary(results),
        "by_capture": {name: _summary(part) for name, part in parts.items()},
        "maps": [str(options.out / f"{name}-difference.png") for name in names] if options.out else [],
    }


def _example(results: list[FrameResult]) -> dict[str, Any]:
    """The most sheared corner, as an example like that of the paper's Table 2."""
    worst = max(results, key=lambda r: float(np.abs(r.outer_deg["none"] - r.truth_deg).max()))
    corner = int(np.abs(worst.outer_deg["none"] - worst.truth_deg).argmax())
    names = ("top left", "top right", "bottom right", "bottom left")
    angles = {method: float(worst.outer_deg[method][corner]) for method in METHODS}
    place = {"capture": worst.capture, "frame": worst.frame, "corner": names[corner]}
    return {**place, "static_deg": float(worst.truth_deg[corner]), "angle_deg": angles}


def _summary(results: list[FrameResult]) -> dict[str, Any]:
    """Statistics over frames, by method; and the corner detector's own error on truth pictures."""
    truth = np.concatenate([r.truth_deg for r in results])
    own = [np.concatenate([r.detector_deg[k] for r in results]) for k in (0, 1)]
    methods = {}
    for method in METHODS:
        outer = np.concatenate([r.outer_deg[method] - r.truth_deg for r in results])
        mse = float(np.mean([r.fidelity[method].mse for r in results]))
        methods[method] = {
            "outer": {**_statistics(outer), "mean_relative_percent": float(np.mean(np.abs(outer) / truth) * 100)},
            "neighbours": _statistics(np.concatenate([r.neighbours_deg[method] for r in results])),
            "mse": mse,
            "psnr_db": psnr_of(mse),
            "mean_frame_psnr_db": float(np.mean([r.fidelity[method].psnr_db for r in results])),
            "ssim": float(np.mean([r.fidelity[method].ssim for r in results])),
        }
    detector = {"outer": _statistics(own[0]), "neighbours": _statistics(own[1])}
    return {"frames": len(results), "methods": methods, "detector_on_truth": detector}


def _statistics(errors_deg: Array) -> dict[str, Any]:
    return {
        "mean_abs_deg": float(np.mean(np.abs(errors_deg))),
        "std_deg": float(np.std(errors_deg)),
        "max_abs_deg": float(np.max(np.abs(errors_deg))),
        "count": len(errors_deg),
    }


def _text(facts: dict[str, Any]) -> str:
    example, whole = facts["example"], facts["all"]
    parts = [
        f"CASE A, rolling shutter: {facts['frames']} frames of {len(facts['captures'])} captures, {facts['versions']}",
        f"\nOne corner, as in the paper's Table 2: {example['corner']}, {example['capture']} frame {example['frame']}",
        _example_table(example),
        "\nAngles between the board's outer corners (eq 29), |frame - truth| in degrees",
        _angle_table(whole, "outer"),
        "\nThe same between neighbouring corners",
        _angle_table(whole, "neighbours"),
        "\nFrames around the board compared with truth (PSNR of the mean MSE)",
        _fidelity_table(whole),
    ]
    if len(facts["by_capture"]) > 1:
        parts += ["\nMean |difference| at the outer corners, degrees, by capture", _capture_table(facts["by_capture"])]
    parts += [f"\n{_account(facts)}"]
    return "\n".join(parts)


def _example_table(example: Mapping[str, Any]) -> str:
    static = example["static_deg"]
    rows = [["static (truth)", f"{static:.2f}", "-", "-"]]
    for method, angle in example["angle_deg"].items():
        apart = abs(angle - static)
        rows.append([method, f"{angle:.2f}", f"{apart:.3f}", f"{100 * apart / static:.3f}"])
    return numeric_table(["picture", "angle", "absolute", "relative %"], rows)


def _angle_table(summary: Mapping[str, Any], key: str) -> str:
    rows = [[method, *_angle_cells(found[key])] for method, found in summary["methods"].items()]
    rows.append(["(detector on truth)", *_angle_cells(summary["detector_on_truth"][key])])
    return numeric_table(["method", "mean", "std", "max", "relative %", "angles"], rows)


def _angle_cells(found: Mapping[str, Any]) -> list[str]:
    numbers = [f"{found[name]:.4f}" for name in ("mean_abs_deg", "std_deg", "max_abs_deg")]
    return [*numbers, cell(found.get("mean_relative_percent"), ".4f"), str(found["count"])]


def _fidelity_table(summary: Mapping[str, Any]) -> str:
    rows = [
        [method, f"{found['mse']:.2f}", f"{found['psnr_db']:.2f}", f"{found['ssim']:.4f}"]
        for method, found in summary["methods"].items()
    ]
    return numeric_table(["method", "MSE", "PSNR dB", "SSIM"], rows)


def _capture_table(by_capture: Mapping[str, Any]) -> str:
    rows = [
        [name, str(part["frames"]), *(f"{part['methods'][m]['outer']['mean_abs_deg']:.4f}" for m in METHODS)]
        for name, part in by_capture.items()
    ]
    return numeric_table(["capture", "frames", *METHODS], rows)


def _account(facts: Mapping[str, Any]) -> str:
    """The data and the conditions of the measurement."""
    lines = [f"{method}: {what}" for method, what in facts["methods"].items()]
    for s in facts["simulated"]:
        where = "far" if np.isinf(s["depth_m"]) else f"{s['depth_m']:g} m away, moving {s['travel_m_s']:g} m/s"
        lines.append(
            f"{s['name']}: seed {s['seed']}, {s['width']}x{s['height']}, {s['frames']} frames, {where}, rotating "
            f"{s['turn_rad_s']:g} rad/s, exposure {s['exposure_ms']:g} ms, readout {s['readout_ms']:g} ms, "
            f"noise {s['noise_levels']:g} levels, {facts['simulated_bits_per_px']:g} bits/px"
        )
    lines += [f"{name}: board not found in {n['without_board']} more frames"
              for name, n in facts["captures"].items() if n["without_board"]]  # fmt: skip
    return "\n".join([*lines, *(f"wrote {path}" for path in facts["maps"])])
