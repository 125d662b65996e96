"""Frames a second from the movie to PNGs, and against scikit-image on the same machine at the same time.

The program runs over N and over 2 N frames of one looped 720x1280 capture with two processes; the difference of the
two wall-clock times, over N, is the time of a frame without starting, reading and planning.
"""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.peers import PEERS, frame_motions, peer_deblurred
from virest.app.bench.tables import table
from virest.app.bench.workload import PRESETS, Run, Scale, looped_capture, recorded_frames, run_process, simulated

FRAMES = {"fast": 120, "balanced": 80, "best": 20}
QUICK_FRAMES = {"fast": 60, "balanced": 40, "best": 4}
JOBS = 2
PEER_TRIES = 2
"""The quicker one counts."""
STAGES = ("decode", "estimate", "deblur", "shutter", "write")
PEER_SETTINGS = {"wiener": 0.1, "unsupervised_wiener": 0.0, "richardson_lucy": 30}


def speed_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Time each preset, then each peer on one frame."""
    counts = QUICK_FRAMES if scale.quick else FRAMES
    capture = looped_capture(work, 2 * max(counts.values()))
    presets = [_time_preset(work, capture, preset, counts[preset]) for preset in PRESETS]
    peers = _time_peers(work)
    facts = {"jobs": JOBS, "size": "720x1280", "presets": presets, "peers_s_per_frame": peers}
    return facts, _text(presets, peers)


def _time_preset(work: Path, capture: Path, preset: str, frames: int) -> dict[str, Any]:
    runs = [_run(work, capture, preset, count) for count in (frames, 2 * frames)]
    per_frame_s = (runs[1].wall_s - runs[0].wall_s) / frames
    lines = runs[1].lines
    return {
        "preset": preset,
        "frames": [frames, 2 * frames],
        "wall_s": [run.wall_s for run in runs],
        "s_per_frame": per_frame_s,
        "frames_per_s": 1 / per_frame_s,
        "stage_s": {stage: float(np.mean([line["seconds"].get(stage, 0.0) for line in lines])) for stage in STAGES},
    }


def _run(work: Path, capture: Path, preset: str, frames: int) -> Run:
    out = work / "speed"
    run = run_process(capture, out, "--preset", preset, "--jobs", str(JOBS), "--frames", f":{frames}")
    shutil.rmtree(out)
    return run


def _time_peers(work: Path) -> dict[str, float]:
    """Seconds of one core for deblurring one colour frame; no decoding, warping or writing."""
    capture = simulated(work, "loop-source")
    curve, motions = frame_motions(capture)
    number, picture = next(recorded_frames(capture))
    seconds = {}
    for name, (method, _) in PEERS.items():
        tries = []
        for _ in range(PEER_TRIES):
            began = time.perf_counter()
            peer_deblurred(method, PEER_SETTINGS[name], picture, motions[number], curve)
            tries.append(time.perf_counter() - began)
        seconds[name] = min(tries)
    return seconds


def _text(presets: list[dict[str, Any]], peers: dict[str, float]) -> str:
    header = [
        "preset",
        "frames/s",
        "frames",
        *(f"{stage} ms" for stage in STAGES),
        *(f"{name} / deblur" for name in peers),
    ]
    rows = []
    for entry in presets:
        stages = entry["stage_s"]
        ratios = [f"{seconds / stages['deblur']:.1f}" for seconds in peers.values()]
        times = [f"{1000 * stages[stage]:.0f}" for stage in STAGES]
        counts = "{}, {}".format(*entry["frames"])
        rows.append([entry["preset"], f"{entry['frames_per_s']:.1f}", counts, *times, *ratios])
    listed = ", ".join(f"{name} {1000 * seconds:.0f}" for name, seconds in peers.items())
    return (
        "SPEED: 720x1280 colour, decode to PNG, --jobs 2; from the difference of runs over N and 2 N frames\n"
        "(stages: one core's ms a frame; last columns: a peer's time for one frame over the deblur stage's)\n"
        + table(header, rows)
        + f"\nscikit-image, ms a colour frame on one core, deblurring only: {listed}"
    )
