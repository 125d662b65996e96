"""Cost of processing 10,000 captures of 5 min, from the CPU times of the section ``speed``.

$ python -m virest.app.bench --only speed --only cost
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from virest.app.bench.speed import JOBS
from virest.app.bench.workload import Scale, looped_capture, run_process
from virest.app.console import numeric_table

CAPTURES, MINUTES, FPS = 10_000, 5, 30
"""Assumption: the archive to process, of 5 min at 30 frames/s each."""
DOLLARS_PER_CORE_HOUR = 0.04
"""Assumption: a rented core with 4 GB, on demand; spot prices are a third."""
DOLLARS_PER_TB_MONTH = 23.0
"""Assumption: object storage."""
LINK_GBIT_S = 10.0
"""Assumption: write bandwidth of the storage."""
SAMPLE_FRAMES = 30
"""One second of movie, with one key frame."""


def cost_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Extrapolate CPU hours, bytes and dollars, and the number of cores that saturate the storage link."""
    presets = _measured(work.parent / "bench.json")
    if not presets:
        return {}, "COST: needs the frame rates of --only speed, in the same bench.json"
    picture_bytes, movie_bytes = _bytes_per_frame(work)
    frames = CAPTURES * MINUTES * 60 * FPS
    rows = [_cost(preset, rate / JOBS, frames, picture_bytes) for preset, rate in presets.items()]
    facts = {"frames": frames, "movie_tb": frames * movie_bytes / 1e12, "pictures_tb": frames * picture_bytes / 1e12}
    return {**facts, "presets": rows}, _text(facts, rows)


def _measured(path: Path) -> dict[str, float]:
    """Frames per second of each preset with JOBS processes, by CPU time, since core hours are billed."""
    if not path.is_file():
        return {}
    report = json.loads(path.read_text(encoding="utf-8"))
    presets = report.get("speed", {}).get("presets", [])
    return {entry["preset"]: entry["frames_per_s_by_cpu"] for entry in presets}


def _bytes_per_frame(work: Path) -> tuple[float, float]:
    """Bytes per frame of the PNGs and of the movie."""
    capture, out = looped_capture(work, SAMPLE_FRAMES), work / "cost"
    run = run_process(capture, out, "--preset", "fast", "--jobs", str(JOBS))
    sizes = [(run.folder / line["output"]).stat().st_size for line in run.lines if line["output"]]
    shutil.rmtree(out)
    return sum(sizes) / len(sizes), (capture / "movie.mp4").stat().st_size / SAMPLE_FRAMES


def _cost(preset: str, per_core_s: float, frames: int, picture_bytes: float) -> dict[str, Any]:
    """CPU hours and dollars, and the number of cores that saturate the storage link."""
    hours = frames / per_core_s / 3600
    return {
        "preset": preset,
        "core_hours": hours,
        "dollars": hours * DOLLARS_PER_CORE_HOUR,
        "cores_that_fill_the_link": LINK_GBIT_S * 1e9 / 8 / (picture_bytes * per_core_s),
    }


def _text(facts: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    header = ["preset", "core hours", f"$ at {DOLLARS_PER_CORE_HOUR}", f"cores that fill {LINK_GBIT_S:.0f} Gbit/s"]
    lines = [
        [row["preset"], f"{row['core_hours']:,.0f}", f"{row['dollars']:,.0f}", f"{row['cores_that_fill_the_link']:.0f}"]
        for row in rows
    ]
    month = facts["pictures_tb"] * DOLLARS_PER_TB_MONTH
    return (
        f"COST: {CAPTURES:,} captures of {MINUTES} minutes, 720x1280 at {FPS} frames/s: {facts['frames']:,} frames, "
        f"{facts['movie_tb']:.1f} TB of movies in, {facts['pictures_tb']:.0f} TB of PNGs out (${month:,.0f} a month)\n"
        + numeric_table(header, lines)
    )
