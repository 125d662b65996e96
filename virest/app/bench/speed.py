"""Frames per second from movie to PNGs, by preset and stage, compared with a floor, parallel runs and other libraries.

The program runs over N and over 2 N frames of one looped 720x1280 capture.  The difference of the two wall-clock times
divided by N is the time per frame, excluding start-up, reading and planning.  N is a whole number of segments per
process.  The floor is the same program without deblurring: only decoding, warping and PNG encoding remain.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from virest.app.bench.peers import (
    GET_DEEPINV,
    PEERS,
    deepinv_available,
    deepinv_wiener,
    frame_motions,
    peer_deblurred,
)
from virest.app.bench.workload import PRESETS, Run, Scale, looped_capture, recorded_frames, run_process
from virest.app.console import cell, numeric_table
from virest.app.machine import processor
from virest.app.planning import estimate_plan
from virest.app.worker_processes import prepare_worker
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.video import probe_movie
from virest.image_formation import transforms
from virest.restoration.settings import PRESETS as SETTINGS

FLOOR = "floor"
ARGUMENTS = {FLOOR: ("--preset", "fast", "--deblur", "none"), **{preset: ("--preset", preset) for preset in PRESETS}}
FRAMES = {FLOOR: 120, "fast": 120, "balanced": 120, "best": 60}
QUICK_FRAMES = dict.fromkeys(FRAMES, 60)
"""Frames N with two processes, in segments of ten; one process gets half as many.  N covers whole loops of the capture,
since its frames differ in blur."""
JOBS = 2
"""The fewest that show how the speed scales."""
PEER_TRIES = 2
"""Number of runs, of which the faster counts."""
STAGES = ("decode", "estimate", "deblur", "shutter", "write")
FLOOR_STAGES = ("decode", "shutter", "write")
PEER_SETTINGS = {"wiener": 0.1, "unsupervised_wiener": 0.0, "richardson_lucy": 30}
DEEPINV_ROW = "deepinv wiener"
CAPTURE_S, FPS = 30.0, 30.0
"""Length of the capture for which the share of estimation, including planning, is reported."""
LEAST_S = 1e-5
"""A stage faster than this counts as not run."""
CONTENT = "dead leaves"
"""Content of the looped capture: the simulator's default scene."""
Facts = dict[str, Any]


def speed_section(work: Path, scale: Scale) -> tuple[Facts, str]:
    """Time the floor and each preset with one and with two processes, then each peer on one frame."""
    counts = QUICK_FRAMES if scale.quick else FRAMES
    capture = looped_capture(work, 2 * max(counts.values()))
    measured = [_time_preset(work, capture, name, counts[name]) for name in ARGUMENTS]
    planning_s = _planning_cpu_s(capture)
    peers = _time_peers(capture)
    facts = {
        "jobs": JOBS,
        "size": "720x1280",
        "content": CONTENT,
        "blur_px": measured[0]["blur_px"],
        "processor": processor() or "unknown processor",
        "transforms": transforms.in_use(),
        "planning_cpu_s": planning_s,
        **judged(measured, planning_s),
        "peers_s_per_frame": peers,
        "peers_missing": {} if DEEPINV_ROW in peers else {DEEPINV_ROW: GET_DEEPINV},
    }
    return facts, speed_text(facts)


# ── the program ──────────────────────────────────────────────────────────────────────────────────────────────────


def _time_preset(work: Path, capture: Path, name: str, frames: int) -> Facts:
    """One record: measured with JOBS processes, and under ``one_process`` with one."""
    one = timed_difference(work, capture, frames // JOBS, "--jobs", "1", *ARGUMENTS[name])
    entry = timed_difference(work, capture, frames, "--jobs", str(JOBS), *ARGUMENTS[name])
    return {"preset": name, **entry, "one_process": one}


def timed_difference(work: Path, capture: Path, frames: int, *arguments: str) -> Facts:
    """Time per frame, from the difference of runs over N and 2 N frames."""
    return per_frame(_run(work, capture, frames, *arguments), _run(work, capture, 2 * frames, *arguments), frames)


def _run(work: Path, capture: Path, frames: int, *arguments: str) -> Run:
    out = work / "speed"
    run = run_process(capture, out, *arguments, "--frames", f":{frames}")
    shutil.rmtree(out)
    return run


def per_frame(shorter: Run, longer: Run, frames: int) -> Facts:
    """Wall-clock and CPU seconds per frame, from runs that differ by ``frames``; stages from the longer run's log.

    stage_s is measured by the workers' clocks; stage_cpu_s divides the CPU time among the stages in proportion.  Under
    load by other processes the longer run may even take less time; such a difference gives no rate.
    """
    wall_s = (longer.wall_s - shorter.wall_s) / frames
    cpu_s = (longer.timing.cpu_s - shorter.timing.cpu_s) / frames
    stage_s = {stage: float(np.mean([line["seconds"].get(stage, 0.0) for line in longer.lines])) for stage in STAGES}
    whole_s = sum(stage_s.values())
    done = [line for line in longer.lines if line["status"] != "skipped"]
    return {
        "frames": [len(shorter.lines), len(longer.lines)],
        "wall_s": [shorter.wall_s, longer.wall_s],
        "s_per_frame": wall_s,
        "blur_px": float(np.median([line["blur"]["length_px"] for line in done])),
        "frames_per_s": over(1.0, wall_s),
        "cpu_s_per_frame": cpu_s,
        "stage_s": stage_s,
        "stage_cpu_s": {stage: cpu_s * s / whole_s for stage, s in stage_s.items()},
        "straightened": all(line["shutter"]["method"] != "none" for line in done),
        "deblurred": float(np.mean([line["deblur"]["method"] != "none" for line in done])),
        "others_cores": max(shorter.timing.others_cores, longer.timing.others_cores),
    }


def judged(measured: list[Facts], planning_s: float) -> Facts:
    """Floor and presets, each with its share of the floor, its share of estimation and its scaling to two processes."""
    floor = next(entry for entry in measured if entry["preset"] == FLOOR)
    entries = [{**entry, **_shares(entry, floor, planning_s)} for entry in measured]
    pure = floor["straightened"] and floor["deblurred"] == 0.0
    kept = {"pure": pure} if pure else {"pure": pure, "share_of_floor": None, "share_of_floor_by_cpu": None}
    presets = [entry if pure else {**entry, **kept} for entry in entries if entry["preset"] != FLOOR]
    return {"floor": {**next(e for e in entries if e["preset"] == FLOOR), **kept}, "presets": presets}


def _shares(entry: Facts, floor: Facts, planning_s: float) -> Facts:
    """Ratios of the measured times.

    Figures by CPU time are what a quiet machine allows if no process ever waits; under other load wall-clock times
    cannot show this.  While one process plans, the others are idle, so planning counts in full.
    """
    one, stages = entry["one_process"], entry["stage_s"]
    estimate, frames = stages["estimate"] / sum(stages.values()), CAPTURE_S * FPS
    frames_s = frames * entry["cpu_s_per_frame"] / JOBS
    return {
        "frames_per_s_by_cpu": JOBS / entry["cpu_s_per_frame"],
        "share_of_floor": over(floor["s_per_frame"], entry["s_per_frame"]),
        "share_of_floor_by_cpu": floor["cpu_s_per_frame"] / entry["cpu_s_per_frame"],
        "share_of_floor_by_stages": sum(stages[stage] for stage in FLOOR_STAGES) / sum(stages.values()),
        "scaling": over(one["s_per_frame"], entry["s_per_frame"]),
        "scaling_by_cpu": JOBS * one["cpu_s_per_frame"] / entry["cpu_s_per_frame"],
        "estimate_share": estimate,
        "estimate_share_with_planning": (planning_s + frames_s * estimate) / (planning_s + frames_s),
        "busiest_others_cores": max(entry["others_cores"], one["others_cores"]),
    }


def over(above: float, below: float) -> float | None:
    """Ratio of two times; None if one is not positive."""
    return above / below if above > 0 and below > 0 else None


def _planning_cpu_s(folder: Path) -> float:
    """CPU seconds of planning: estimating unknown profile values and checking frames against the gyroscope."""
    prepare_worker()
    capture = read_capture(folder)
    profile, _ = resolve_profile(capture, None)
    index = probe_movie(capture.movie)
    began = time.process_time()
    estimate_plan(capture, index, profile, SETTINGS["fast"])
    return time.process_time() - began


# ── others ───────────────────────────────────────────────────────────────────────────────────────────────────────


def _time_peers(capture: Path) -> dict[str, float]:
    """CPU seconds per method for deblurring one colour frame on one thread, without decoding, warping or writing."""
    curve, motions = frame_motions(capture)
    number, picture = next((n, picture) for n, picture in recorded_frames(capture) if n in motions)
    methods = {name: (method, PEER_SETTINGS[name]) for name, (method, _) in PEERS.items()}
    if deepinv_available():
        methods[DEEPINV_ROW] = (deepinv_wiener, PEER_SETTINGS["wiener"])
        deepinv_wiener(np.zeros((16, 16), np.float32), np.eye(3, dtype=np.float32), 0.1)  # loads the libraries

    def once(method: Any, setting: float) -> Callable[[], Any]:
        return lambda: peer_deblurred(method, setting, picture, motions[number], curve)

    cv2.setNumThreads(1)
    return {name: min(_cpu_s(once(*chosen)) for _ in range(PEER_TRIES)) for name, chosen in methods.items()}


def _cpu_s(work: Callable[[], Any]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


# ── text ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def speed_text(facts: Facts) -> str:
    """Tables of the program and of its peers."""
    return _program_text(facts) + "\n\n" + _peers_text(facts)


def _program_text(facts: Facts) -> str:
    header = ["preset", "frames/s", "by CPU", "of floor", "by CPU", "by stages", *STAGES, "estimation", "with planning"]
    header += ["1 process", "1 -> 2", "by CPU", "CPU ms", "others' cores"]
    rows = []
    for entry in [facts["floor"], *facts["presets"]]:
        one = entry["one_process"]
        rows.append([
            entry["preset"], cell(entry["frames_per_s"]), cell(entry["frames_per_s_by_cpu"]),
            percent(entry["share_of_floor"]), percent(entry["share_of_floor_by_cpu"]),
            percent(entry["share_of_floor_by_stages"]), *(stage_rate(entry["stage_cpu_s"][stage]) for stage in STAGES),
            percent(entry["estimate_share"]), percent(entry["estimate_share_with_planning"]),
            cell(one["frames_per_s"]), cell(entry["scaling"]), cell(entry["scaling_by_cpu"]),
            f"{1000 * entry['cpu_s_per_frame']:.0f}", f"{entry['busiest_others_cores']:.1f}",
        ])  # fmt: skip
    planned = f"its {facts['planning_cpu_s']:.1f} s in a capture of {CAPTURE_S:.0f} s"
    pure = "decode, warp and PNG only" if facts["floor"]["pure"] else "NOT MEASURED: these frames are not all warped"
    return (
        f"SPEED: {facts['processor']}, --jobs {facts['jobs']}, transforms by {facts['transforms']}\n"
        f"{facts['size']} colour, {facts['content']}, blur of {facts['blur_px']:.1f} px (median), decode to PNG; "
        "from runs over N and 2 N frames\n"
        f"(floor: --deblur none, {pure}; by stages: decode + shutter + write of the preset's own run;\n"
        f" by CPU: what the CPU times allow; stages: frames/s of one core by CPU time; with planning: {planned};\n"
        " others' cores: load by other processes)\n" + numeric_table(header, rows)
    )


def _peers_text(facts: Facts) -> str:
    presets = facts["presets"]
    rows = []
    for name, seconds in facts["peers_s_per_frame"].items():
        ratios = [ratio_to_peer(seconds, entry) for entry in presets]
        rows.append([name, f"{1000 * seconds:.0f}", *(cell(r, ".1f") for r in ratios)])
    rows += [[name, why, *("-" for _ in presets)] for name, why in facts["peers_missing"].items()]
    return (
        "PEERS: one colour frame deblurred on one core, CPU ms; then as a multiple of the deblur stage's\n"
        "(scikit-image and deepinv with one kernel for the whole frame)\n"
        + numeric_table(["peer", "ms", *(f"/ {entry['preset']}" for entry in presets)], rows)
    )


def ratio_to_peer(peer_s: float, entry: Facts) -> float | None:
    """A peer's CPU time over that of a preset's deblurring with one process; None if the preset did not deblur."""
    ours_s: float = entry["one_process"]["stage_cpu_s"]["deblur"]
    return peer_s / ours_s if ours_s > LEAST_S else None


def stage_rate(seconds: float) -> str:
    """Frames per second of one stage on one core."""
    return f"{1 / seconds:.4g}" if seconds > LEAST_S else "-"


def percent(share: float | None) -> str:
    """A share as text, in %."""
    return "-" if share is None else f"{100 * share:.1f} %"
