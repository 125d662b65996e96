"""Growth of the time per frame with the number of frames (none expected), of pixels, and of tiles.

$ python -m virest.app.bench --only growth --quick
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.speed import JOBS, timed_difference
from virest.app.bench.workload import Scale, looped_capture, run_process
from virest.app.console import numeric_table

PRESET = "fast"
FRAMES, QUICK_FRAMES = 100, 40
"""N; runs over N, 2 N and 4 N frames."""
SIZES = ((360, 640), (540, 960), (720, 1280))
"""Areas of 1, 2.25 and 4: enough for the exponent of the time over the pixels."""
SIZE_FRAMES, QUICK_SIZE_FRAMES = 20, 10
"""N for each size; the time per frame is the difference of runs over N and 2 N."""
TILES_PX = (72, 104, 144, 208)
"""About the usual 104 px by factors of √2, so that the area doubles."""
Facts = dict[str, Any]


def growth_section(work: Path, scale: Scale) -> tuple[Facts, str]:
    """Measure all three in sequence on the same machine, by CPU time."""
    frames, few = (QUICK_FRAMES, QUICK_SIZE_FRAMES) if scale.quick else (FRAMES, SIZE_FRAMES)
    facts = {
        "preset": PRESET,
        "frames": _over_frames(work, frames),
        "pixels": _over_pixels(work, few),
        "tiles": _over_tiles(work, few),
    }
    return facts, growth_text(facts)


# ── measuring ────────────────────────────────────────────────────────────────────────────────────────────────────


def _over_frames(work: Path, frames: int) -> Facts:
    """Time of whole runs over N, 2 N and 4 N frames."""
    capture = looped_capture(work, 4 * frames)
    rows = []
    for count in (frames, 2 * frames, 4 * frames):
        out = work / "growth"
        run = run_process(capture, out, "--preset", PRESET, "--jobs", str(JOBS), "--frames", f":{count}")
        shutil.rmtree(out)
        rows.append({"frames": count, "wall_s": run.wall_s, "cpu_s": run.timing.cpu_s})
    return {"rows": with_steps(rows), **doubling_exponents(rows)}


def _over_pixels(work: Path, frames: int) -> Facts:
    """Time per frame for three sizes, from the difference of two runs with one process."""
    rows = []
    for width, height in SIZES:
        capture = looped_capture(work, 2 * frames, width, height)
        found = timed_difference(work, capture, frames, "--jobs", "1", "--preset", PRESET)
        rows.append({"size": f"{width}x{height}", "pixels": width * height, **_times(found)})
    return {"rows": rows, **_fitted(rows, "pixels", "cpu_s_per_frame")}


def _over_tiles(work: Path, frames: int) -> Facts:
    """Time of deblurring for several tile sizes; the program uses the fastest size near the requested one."""
    width, height = SIZES[-1]
    capture = looped_capture(work, 2 * frames, width, height)
    rows = []
    for side in TILES_PX:
        settings = work / f"tiles-{side}.yaml"
        settings.write_text(f"virest_settings: 1\npreset: {PRESET}\ntile_px: {side}\n", encoding="utf-8")
        found = timed_difference(work, capture, frames, "--jobs", "1", "--settings", str(settings))
        rows.append({"tile_px": side, "tiles": width * height / side**2, **_times(found)})
    return {"rows": rows, **_fitted(rows, "tiles", "deblur_cpu_s")}


def _times(found: Facts) -> Facts:
    chosen = {key: found[key] for key in ("s_per_frame", "cpu_s_per_frame", "others_cores")}
    return {**chosen, "deblur_cpu_s": found["stage_cpu_s"]["deblur"]}


# ── fits ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def fitted_exponent(sizes: Sequence[float], times: Sequence[float]) -> tuple[float, float | None]:
    """Exponent p of time = c · size^p by log-log least squares, and its standard deviation (None below three sizes)."""
    x, y = np.log(np.asarray(sizes, float)), np.log(np.asarray(times, float))
    x = x - x.mean()
    exponent = float(x @ y / (x @ x))
    if len(x) < 3:
        return exponent, None
    residual = y - y.mean() - exponent * x
    return exponent, float(np.sqrt(residual @ residual / (len(x) - 2) / (x @ x)))


def _fitted(rows: list[Facts], size: str, seconds: str) -> Facts:
    """Exponent over the rows; None if load by other processes made a difference of two runs negative."""
    if any(row[seconds] <= 0 for row in rows):
        return {"exponent": None, "std": None}
    exponent, std = fitted_exponent([row[size] for row in rows], [row[seconds] for row in rows])
    return {"exponent": exponent, "std": std}


def doubling_exponents(rows: list[Facts]) -> dict[str, float | None]:
    """Exponent p of time = start + c · frames^p from runs over N, 2 N and 4 N frames; 1: constant time per frame.

    Exact for three runs: (T(4N) − T(2N)) / (T(2N) − T(N)) = 2^p.
    """

    def exponent(key: str) -> float | None:
        first, second, third = (row[key] for row in rows)
        if third <= second or second <= first:
            return None
        return float(np.log2((third - second) / (second - first)))

    return {"exponent": exponent("cpu_s"), "wall_exponent": exponent("wall_s")}


def with_steps(rows: list[Facts]) -> list[Facts]:
    """Add to each run its time per additional frame relative to the previous run; None for the first."""
    steps: list[Facts] = [{"s_per_frame": None, "cpu_s_per_frame": None}]
    for before, after in pairwise(rows):
        more = after["frames"] - before["frames"]
        walls, cpus = after["wall_s"] - before["wall_s"], after["cpu_s"] - before["cpu_s"]
        steps.append({"s_per_frame": walls / more, "cpu_s_per_frame": cpus / more})
    return [{**row, **step} for row, step in zip(rows, steps, strict=True)]


# ── text ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def growth_text(facts: Facts) -> str:
    """Three tables, each with its exponent."""
    frames, pixels, tiles = facts["frames"], facts["pixels"], facts["tiles"]
    counted = [[str(r["frames"]), f"{r['wall_s']:.1f}", f"{r['cpu_s']:.1f}", _ms(r["s_per_frame"]),
                _ms(r["cpu_s_per_frame"])] for r in frames["rows"]]  # fmt: skip
    sized = [[r["size"], str(r["pixels"]), _ms(r["s_per_frame"]), _ms(r["cpu_s_per_frame"])] for r in pixels["rows"]]
    tiled = [[str(r["tile_px"]), f"{r['tiles']:.0f}", _ms(r["cpu_s_per_frame"]), _ms(r["deblur_cpu_s"])]
             for r in tiles["rows"]]  # fmt: skip
    return (
        f"GROWTH: preset {facts['preset']}; ms per frame without start-up and planning; time grows as size^p\n"
        f"frames: p = {exponent_text(frames)} (1: the time per frame does not depend on the movie's length)\n"
        + numeric_table(["frames", "wall s", "CPU s", "ms per added frame", "CPU ms per added frame"], counted)
        + f"\n\npixels: p = {exponent_text(pixels)} of the CPU time; blur paths grow with the picture's side\n"
        + numeric_table(["size", "pixels", "ms per frame", "CPU ms"], sized)
        + f"\n\ntiles: p = {exponent_text(tiles)} of the CPU time of deblurring; tiles by tile_px\n"
        + numeric_table(["tile_px", "tiles", "CPU ms per frame", "deblurring"], tiled)
    )


def exponent_text(fit: Facts) -> str:
    """An exponent as text, with its standard deviation if known."""
    if fit["exponent"] is None:
        return "not determined by these runs"
    return f"{fit['exponent']:.2f}" + (f" ± {fit['std']:.2f}" if fit.get("std") is not None else "")


def _ms(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1000 * seconds:.0f}"
