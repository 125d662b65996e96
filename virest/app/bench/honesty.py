"""Predicted against measured gain of deblurring, for each frame with truth.

Measured gain: PSNR of the restored frame minus that of ``--deblur none`` with the same warp.  A frame that is not
deblurred has no prediction and a gain of 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.workload import Scale, Workload, honesty_workloads, run_process, simulated
from virest.app.console import cell, emit, numeric_table
from virest.app.evaluation_captures import truth_frame
from virest.evaluation.fidelity import psnr_db

Row = dict[str, Any]
WORSE_DB = 0.1
"""A frame that loses more than this counts as made worse."""
NOMINAL, DEFOCUSED, PHONE = "nominal", "defocused", "phone"
"""Sets of captures: conforming to the camera model; with defocus in the profile; with a phone's own processing."""
SETS = (NOMINAL, DEFOCUSED, PHONE)


def honesty_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Measure every frame of every capture with each preset."""
    rows: list[Row] = []
    for workload in honesty_workloads(scale):
        found = measure_honesty(work, workload, scale.presets)
        rows += found
        emit(frames_text(found, scale.presets) + "\n")
    summary = summarise_honesty(rows)
    return {"frames": rows, "summary": summary}, honesty_text(summary)


def measure_honesty(work: Path, workload: Workload, presets: Sequence[str]) -> list[Row]:
    """One record per frame and preset: predicted gain (None if none), its standard deviation, measured gain, in dB."""
    capture = simulated(work, workload.name, **workload.options)
    arguments = workload.arguments(capture)
    base = run_process(capture, work / "none", "--deblur", "none", *arguments)
    truths = [truth_frame(capture, line["frame"]) for line in base.lines]
    straight_db = [
        psnr_db(base.picture(line), truth, line["valid_px"]) for line, truth in zip(base.lines, truths, strict=True)
    ]
    rows = []
    for preset in presets:
        run = run_process(capture, work / preset, "--preset", preset, *arguments)
        for line, under, truth, before_db in zip(run.lines, base.lines, truths, straight_db, strict=True):
            after_db = psnr_db(run.picture(line), truth, under["valid_px"])
            rows.append(_row(workload, preset, line, before_db, after_db))
    return rows


def summarise_honesty(rows: Sequence[Row]) -> list[Row]:
    """One record for each set and preset, and for each capture and preset."""
    names = dict.fromkeys((row["set"], row["capture"]) for row in rows)
    groups: list[tuple[str, str | None]] = [(s, None) for s in SETS if any(s == of for of, _ in names)]
    presets = dict.fromkeys(row["preset"] for row in rows)
    return [
        _summary(kind, name, preset, chosen)
        for kind, name in [*names, *groups]
        for preset in presets
        if (chosen := [r for r in rows if r["set"] == kind and name in (None, r["capture"]) and r["preset"] == preset])
    ]


def frames_text(rows: Sequence[Row], presets: Sequence[str]) -> str:
    """One line per frame of one capture: predicted and measured gain of each preset."""
    header = ["capture", "frame", "blur px", "straight dB", *(f"{p}: predicted / measured gain" for p in presets)]
    lines: dict[int, list[str]] = {}
    for row in rows:
        start = [row["capture"], str(row["frame"]), f"{row['blur_px']:.1f}", f"{row['straightened_db']:.2f}"]
        cells = lines.setdefault(row["frame"], start)
        mark = " !" if row["gain_db"] < -WORSE_DB else ""
        cells.append(f"{cell(row['promise_db'], '+.2f')} / {cell(row['gain_db'], '+.2f')}{mark}")
    return numeric_table(header, list(lines.values()))


def honesty_text(summary: Sequence[Row]) -> str:
    """Table of all captures, followed by the sets in capitals."""
    header = ["capture", "preset", "frames", "deblurred", "mean gain", "worse", "their mean", "worst",
              "predicted", "|error|", "predicted, worse"]  # fmt: skip
    lines = [_summary_cells(entry) for entry in summary]
    return (
        f"HONESTY: gain in dB over straightening alone; worse: frames that lose more than {WORSE_DB} dB\n"
        "(predicted: frames with an expected_gain_db; |error|: median of their |predicted - measured gain|)\n"
        + numeric_table(header, lines)
    )


# ── parts ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _row(workload: Workload, preset: str, line: Row, before_db: float, after_db: float) -> Row:
    deblur = line["deblur"]
    done = deblur["method"] != "none"
    return {
        "set": workload.kind if workload.kind in (DEFOCUSED, PHONE) else NOMINAL,
        "capture": workload.name,
        "preset": preset,
        "frame": line["frame"],
        "blur_px": line["blur"]["length_px"],
        "straightened_db": before_db,
        "deblurred": done,
        "promise_db": deblur.get("expected_gain_db") if done else None,
        "promise_std_db": deblur.get("expected_gain_std_db") if done else None,
        "gain_db": after_db - before_db,
    }


def _summary(kind: str, name: str | None, preset: str, rows: Sequence[Row]) -> Row:
    gain = np.array([row["gain_db"] for row in rows])
    worse = gain < -WORSE_DB
    promised = np.array([row["promise_db"] is not None for row in rows])
    promise = np.array([row["promise_db"] or 0.0 for row in rows])
    return {
        "set": kind,
        "capture": name,
        "preset": preset,
        "of": len(rows),
        "deblurred": sum(row["deblurred"] for row in rows),
        "mean_gain_db": float(gain.mean()),
        "worse_share": float(worse.mean()),
        "worse_mean_db": float(gain[worse].mean()) if worse.any() else None,
        "worst_db": float(gain.min()),
        "promised": int(promised.sum()),
        "promise_off": float(np.median(np.abs(promise - gain)[promised])) if promised.any() else None,
        "promised_and_worse": int((worse & (promise > 0)).sum()),
    }


def _summary_cells(entry: Row) -> list[str]:
    return [
        entry["capture"] or f"ALL {entry['set'].upper()}",
        entry["preset"],
        str(entry["of"]),
        str(entry["deblurred"]),
        cell(entry["mean_gain_db"], "+.2f"),
        f"{100 * entry['worse_share']:.0f} %",
        cell(entry["worse_mean_db"], "+.2f"),
        cell(entry["worst_db"], "+.2f"),
        str(entry["promised"]),
        cell(entry["promise_off"]),
        str(entry["promised_and_worse"]),
    ]
