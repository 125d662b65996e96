"""PSNR gain over straightening alone on simulated captures with truth, for presets and peers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.peers import PEERS, frame_motions, peer_pictures
from virest.app.bench.workload import (
    PRESETS,
    Scale,
    Workload,
    quality_workloads,
    recorded_frames,
    run_process,
    simulated,
)
from virest.app.console import CONSOLE, cell, numeric_table
from virest.app.evaluation_captures import truth_frame
from virest.evaluation.fidelity import psnr_db

METHODS = (*PRESETS, *PEERS)
SHORT = {"unsupervised_wiener": "unsup. wiener", "richardson_lucy": "rich.-lucy"}
"""Column headings."""
KIND_TITLES = {
    "ordinary": "ordinary: 5-20 px",
    "photographs": "photographs: 5-20 px",
    "fine": "the same at 1 bit/px",
    "long": "long blur, strong noise: 15-45 px",
    "bright": "bright clipped areas: 5-20 px",
    "shaken": "shaken: 5-45 px, near plane, noise, highlights",
    "phone": "as phones film, nominal profile",
}


def quality_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Measure every frame of every capture: gains in dB over ``--deblur none`` with the same warp."""
    rows = []
    for workload in quality_workloads(scale):
        found = measure_workload(work, workload)
        rows += found
        means = {m: np.mean([row["gain_db"][m] for row in found]) for m in METHODS}
        CONSOLE.line(f"{workload.name}: " + ", ".join(f"{method} {mean:+.2f}" for method, mean in means.items()))
    summary = summarise(rows)
    return {"frames": rows, "summary": summary}, _text(summary)


def measure_workload(work: Path, workload: Workload) -> list[dict[str, Any]]:
    """One record per frame: blur, PSNR of straightening alone, and gain of each preset and peer."""
    capture = simulated(work, workload.name, **workload.options)
    base = run_process(capture, work / "none", "--deblur", "none")
    runs = {preset: run_process(capture, work / preset, "--preset", preset) for preset in PRESETS}
    curve, motions = frame_motions(capture)
    recorded = dict(recorded_frames(capture))
    records = []
    for position, line in enumerate(base.lines):
        frame, valid = line["frame"], line["valid_px"]
        truth = truth_frame(capture, frame)
        base_db = psnr_db(base.picture(line), truth, valid)
        gains = {p: psnr_db(run.picture(run.lines[position]), truth, valid) - base_db for p, run in runs.items()}
        for peer in PEERS:
            tried = [psnr_db(p, truth, valid) for p in peer_pictures(peer, recorded[frame], motions[frame], curve)]
            gains[peer] = max(tried) - base_db
        blur_px = line["blur"]["length_px"]
        low, high = workload.blur_range_px
        records.append(
            {
                "capture": workload.name,
                "kind": workload.kind,
                "frame": frame,
                "blur_px": blur_px,
                "in_range": low <= blur_px <= high,
                "straightened_db": base_db,
                "gain_db": gains,
            }
        )
    return records


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over the frames in range by kind and capture; minima over all frames."""
    groups: list[tuple[str, str | None]] = []
    for kind in KIND_TITLES:
        names = dict.fromkeys(row["capture"] for row in rows if row["kind"] == kind)
        groups += [(kind, name) for name in names] + ([(kind, None)] if names else [])
    return [_summary(kind, name, [r for r in rows if r["kind"] == kind and name in (None, r["capture"])])
            for kind, name in groups]  # fmt: skip


def _summary(kind: str, name: str | None, rows: list[dict[str, Any]]) -> dict[str, Any]:
    counted = [row for row in rows if row["in_range"]]

    def over(chosen: list[dict[str, Any]], how: Any, method: str) -> float | None:
        return float(how([row["gain_db"][method] for row in chosen])) if chosen else None

    return {
        "kind": kind,
        "capture": name,
        "frames": len(counted),
        "of": len(rows),
        "straightened_db": float(np.mean([row["straightened_db"] for row in counted])) if counted else None,
        "mean_gain_db": {method: over(counted, np.mean, method) for method in METHODS},
        "min_gain_db": {method: over(rows, np.min, method) for method in METHODS},
    }


def _text(summary: list[dict[str, Any]]) -> str:
    """Tables of means and minima; a kind gets a summary row only if it has several captures."""
    several = {kind for kind in KIND_TITLES if sum(entry["kind"] == kind for entry in summary) > 2}
    shown = [entry for entry in summary if entry["capture"] or entry["kind"] in several]
    means, minima = [], []
    for entry in shown:
        name = entry["capture"] or f"ALL {KIND_TITLES[entry['kind']]}"
        gains = [cell(entry["mean_gain_db"][method], "+.2f") for method in METHODS]
        means.append([name, f"{entry['frames']}/{entry['of']}", cell(entry["straightened_db"]), *gains])
        minima.append([name, str(entry["of"]), *(cell(entry["min_gain_db"][preset], "+.2f") for preset in PRESETS)])
    return (
        "QUALITY: mean PSNR gain in dB over straightening alone, inside valid_px less 16 px\n"
        "(over the frames whose blur is in range; peers: true centre kernel, linear light,\n"
        " blended border, same warp, best setting for each frame by PSNR against truth)\n"
        + numeric_table(["capture", "frames", "straight dB", *(SHORT.get(method, method) for method in METHODS)], means)
        + "\n\nthe same for the worst frame, at any blur\n"
        + numeric_table(["capture", "of", *PRESETS], minima)
    )
