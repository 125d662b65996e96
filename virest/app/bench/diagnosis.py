"""Accuracy of diagnose: captures with one hidden effect (every effect, several seeds) and captures without any.

The diagnosis reads only the capture folder; the hidden effect is stated in truth/.
"""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.workload import Scale
from virest.app.console import CONSOLE, numeric_table
from virest.app.diagnose import open_source
from virest.app.simulate import simulate_command
from virest.diagnosis.findings import CONSISTENT, Diagnosis
from virest.diagnosis.ladder import diagnose_capture
from virest.effects.table import EFFECTS

FRAMES = 90
"""Three seconds of movie."""
SCENES = ("leaves", "text", "board")
SEEDS = {"quick": 1, "normal": 2, "full": 4}
"""Captures per effect."""
Case = tuple[str, int]


def diagnosis_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Diagnose one capture per effect and seed, and a quarter as many captures without effects."""
    seeds = SEEDS["quick" if scale.quick else "full" if scale.full else "normal"]
    alone = [effect.name for effect in EFFECTS.values() if not effect.beside]
    cases: list[Case] = [(name, 100 * k + i) for k in range(seeds) for i, name in enumerate(alone)]
    cases += [("", 9000 + k) for k in range(max(len(cases) // 4, 2))]
    rows = []
    for case in cases:
        rows.append(diagnose_hidden(work, *case))
        CONSOLE.line("  ".join(filter(None, _shown(rows[-1]))))
    right = [row for row in rows if row["right"]]
    ratios = [r for row in rows for r in row["errors_in_std"]]
    summary = {
        "captures": len(rows),
        "right": len(right),
        "median_error_in_std": float(np.median(ratios)) if ratios else None,
        "within_two_std": float(np.mean(np.array(ratios) < 2)) if ratios else None,
    }
    header = ["hidden", "seed", "verdict", "named", "gain", "|error| / std"]
    text = numeric_table(header, [_shown(row) for row in rows])
    text += f"\n{len(right)} of {len(rows)} right; median |error| / std {summary['median_error_in_std']}"
    return {"summary": summary, "rows": rows}, f"Hidden effects, {FRAMES} frames, 640x480 and 480x640\n{text}"


def diagnose_hidden(work: Path, name: str, seed: int) -> dict[str, Any]:
    """Simulate one effect of random size (none for an empty name), diagnose, and compare with the truth."""
    rng = np.random.default_rng([seed, 77])
    width, height = (480, 640) if seed % 2 else (640, 480)
    folder = work / f"{name or 'null'}_{seed}"
    simulate_command(
        folder, width=width, height=height, frames=FRAMES, seed=seed, scene=SCENES[seed % len(SCENES)],
        rate_rad_s=float(rng.uniform(0.7, 1.5)), exposure_ms=float(rng.uniform(6, 11)),
        noise_levels=float(rng.uniform(1.5, 2.2)), effects=[name] if name else [],
    )  # fmt: skip
    found = diagnose_folder(folder)
    truth = json.loads((folder / "truth" / "effects.json").read_text(encoding="utf-8"))["effects"]
    named = [cause.name for cause in found.causes]
    rivals = {rival.name for cause in found.causes for rival in cause.rivals}
    right = found.verdict == CONSISTENT if not name else len(named) == 1 and name in {*named, *rivals}
    gains = [cause.held_out.gain for cause in found.causes if cause.name == name]
    return {
        "hidden": name, "seed": seed, "verdict": found.verdict, "named": named, "right": right,
        "gain": gains[0] if gains else None,
        "errors_in_std": [r for effect in truth for r in errors_in_std(found, effect["name"], effect["parameters"])],
    }  # fmt: skip


def diagnose_folder(folder: Path) -> Diagnosis:
    """Diagnose a capture folder with its own profile."""
    source = open_source(folder)
    return diagnose_capture(source.capture, source.profile, source.pictures, source.gray)


def errors_in_std(found: Diagnosis, name: str, truth: dict[str, Any]) -> list[float]:
    """|estimate − truth| / std of each number of a named cause; empty for words, and for values not found."""
    ratios: list[float] = []
    for cause in found.causes:
        if cause.name != name:
            continue
        parts = iter(truth.values())
        for key, change in cause.parameters.items():
            of_vector = isinstance(change.estimate, list) and key not in truth
            true = list(islice(parts, len(change.estimate))) if of_vector else truth.get(key)
            if change.std in (None, 0) or true is None or isinstance(true, str):
                continue
            estimate, std, true = (np.atleast_1d(np.array(v, float)) for v in (change.estimate, change.std, true))
            if key == "phase_rad":
                true = estimate + (true - estimate + np.pi) % (2 * np.pi) - np.pi
            if len(true) == len(estimate) == len(std) and len(true) <= 3:
                ratios += (np.abs(estimate - true) / std).tolist()
    return ratios


def _shown(row: dict[str, Any]) -> list[str]:
    errors = " ".join(f"{r:.1f}" for r in row["errors_in_std"])
    gain = "" if row["gain"] is None else f"{row['gain']:.2f}"
    mark = "" if row["right"] else "  WRONG"
    return [row["hidden"] or "nothing", str(row["seed"]), row["verdict"], ", ".join(row["named"]) + mark, gain, errors]
