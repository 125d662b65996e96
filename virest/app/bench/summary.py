"""Final table: targets, measured values, and whether the targets are met."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from virest.app.bench.compare import BUSY_CORES
from virest.app.bench.growth import exponent_text
from virest.app.bench.speed import STAGES, percent, ratio_to_peer, stage_rate
from virest.app.console import cell, numeric_table

Report = dict[str, Any]
LEAST_FLOOR_SHARE, LEAST_SCALING, MOST_ESTIMATION = 0.6, 1.8, 0.05
LEAST_PHONE_GAIN_DB = {"fast": 1.2, "balanced": 1.6, "best": 1.8}
MOST_PREDICTION_OFF_DB = 0.5
LEAST_RATE = {"balanced": 8.0, "best": 0.3}
MOST_WORKER_MB, MOST_GROWTH = 400.0, 1.05
"""What the bench demands: shares of the time, gains and errors in dB, frames per second, memory."""
MOST_EXPONENT = 1.1
"""Exponent of the time over frames: with twice as many frames, each takes at most 7 % longer."""


YES, NO, BUSY, OPEN = "yes", "NO", "busy", "-"
"""Last column.  ``busy``: undecidable because of load by other processes; ``-``: no target or no measurement."""


@dataclass(frozen=True, slots=True)
class Row:
    """One figure with its target."""

    figure: str
    target: str
    measured: str
    met: str = OPEN


def judge(by_wall: bool, by_cpu: bool, others_cores: float, *, ratio: bool = False) -> str:
    """Whether a target is met, on a machine that may have been under load by other processes.

    On a quiet machine wall-clock time decides.  Under load, a target missed by CPU time is missed, since CPU time
    bounds the performance of a quiet machine; a wall-clock time that meets the target meets it, but a ratio of two
    wall-clock times decides nothing.
    """
    if others_cores <= BUSY_CORES:
        return YES if by_wall else NO
    if not by_cpu:
        return NO
    return YES if by_wall and not ratio else BUSY


def summary_rows(report: Report) -> list[Row]:
    """Rows of all sections that were run."""
    return [row for section, build in SECTIONS.items() if report.get(section) for row in build(report[section])]


def summary_text(report: Report) -> str:
    """The table with the machine's load; empty if no section has a target."""
    rows = summary_rows(report)
    if not rows:
        return ""
    versions = report.get("versions", {})
    load = f"{versions.get('cores')} cores, load {versions.get('load', 0.0):.1f} at the start"
    body = numeric_table(
        ["figure", "target", "measured", "met"], [[r.figure, r.target, r.measured, r.met] for r in rows]
    )
    return f"SUMMARY: virest {versions.get('virest')}, scale {report.get('scale')}, {load}\n" + body


# ── rows of each section ─────────────────────────────────────────────────────────────────────────────────────────


def _speed_rows(speed: Report) -> list[Row]:
    presets = speed["presets"]
    rows = [_rate_row(entry) for entry in (speed["floor"], *presets)]
    rows += [_floor_row(entry) for entry in presets]
    rows += [_scaling_row(entry) for entry in presets]
    rows += [_estimation_row(entry) for entry in presets]
    rows += [_stages_row(entry) for entry in (speed["floor"], *presets)]
    return rows + _peer_rows(speed)


def _rate_row(entry: Report) -> Row:
    rate, allowed, least = entry["frames_per_s"], entry["frames_per_s_by_cpu"], LEAST_RATE.get(entry["preset"])
    title, measured = f"{entry['preset']}: frames/s, 2 processes", f"{cell(rate)} ({cell(allowed)} by CPU time)"
    if least is None:
        return Row(title, OPEN, measured)
    return Row(title, f">= {least:g}", measured, judge((rate or 0) >= least, allowed >= least, _others(entry)))


def _floor_row(entry: Report) -> Row:
    shares = [entry[key] for key in ("share_of_floor", "share_of_floor_by_cpu", "share_of_floor_by_stages")]
    measured = "{} ({} by CPU time, {} by its stages)".format(*map(percent, shares))
    title = f"{entry['preset']}: of the floor"
    if entry["preset"] != "fast":
        return Row(title, OPEN, measured)
    by_wall, by_cpu = ((share or 0.0) >= LEAST_FLOOR_SHARE for share in shares[:2])
    met = judge(by_wall, by_cpu, _others(entry), ratio=True) if shares[1] is not None else OPEN
    return Row(title, f">= {percent(LEAST_FLOOR_SHARE)}", measured, met)


def _scaling_row(entry: Report) -> Row:
    scaling, allowed = entry["scaling"], entry["scaling_by_cpu"]
    met = judge((scaling or 0.0) >= LEAST_SCALING, allowed >= LEAST_SCALING, _others(entry), ratio=True)
    measured = f"{cell(scaling)} ({cell(allowed)} by CPU time)"
    return Row(f"{entry['preset']}: 1 -> 2 processes", f">= {LEAST_SCALING:g}", measured, met)


def _others(entry: Report) -> float:
    return float(entry["busiest_others_cores"])


def _estimation_row(entry: Report) -> Row:
    share = entry["estimate_share_with_planning"]
    measured = f"{percent(share)} with planning, {percent(entry['estimate_share'])} of a frame"
    met = YES if share < MOST_ESTIMATION else NO
    return Row(f"{entry['preset']}: estimation", f"< {percent(MOST_ESTIMATION)}", measured, met)


def _stages_row(entry: Report) -> Row:
    rates = ", ".join(f"{stage} {stage_rate(entry['stage_cpu_s'][stage])}" for stage in STAGES)
    return Row(f"{entry['preset']}: frames/s of a core", "-", rates)


def _peer_rows(speed: Report) -> list[Row]:
    """A peer's time for one frame over that of each preset's deblurring."""
    rows = []
    for name, seconds in speed["peers_s_per_frame"].items():
        ratios = [(entry["preset"], ratio_to_peer(seconds, entry)) for entry in speed["presets"]]
        said = ", ".join(f"{preset} {ratio:.2f}" for preset, ratio in ratios if ratio is not None)
        rows.append(Row(f"{_peer_title(name)} / deblur stage", "-", said))
    return rows + [Row(f"{_peer_title(name)} / deblur stage", "-", why) for name, why in speed["peers_missing"].items()]


def _peer_title(name: str) -> str:
    return name if " " in name else f"scikit-image {name}"


def _growth_rows(growth: Report) -> list[Row]:
    exponent = growth["frames"]["exponent"]
    met = OPEN if exponent is None else YES if exponent <= MOST_EXPONENT else NO
    return [
        Row("time over frames, exponent", f"<= {MOST_EXPONENT:g}", exponent_text(growth["frames"]), met),
        Row("time of a frame over pixels, exponent", "-", exponent_text(growth["pixels"])),
        Row("deblurring over tiles, exponent", "-", exponent_text(growth["tiles"])),
    ]


def _memory_rows(memory: Report) -> list[Row]:
    worker_mb = max(run["worker_mb"] for run in memory["runs"])
    grown, counts = memory["grown"], [run["frames"] for run in memory["runs"]]
    return [
        Row(
            "memory of the largest worker",
            f"< {MOST_WORKER_MB:g} MB",
            f"{worker_mb:.0f} MB",
            YES if worker_mb < MOST_WORKER_MB else NO,
        ),
        Row(
            f"memory, {counts[-1]} over {counts[0]} frames",
            f"<= {MOST_GROWTH:g}",
            f"worker {grown['worker']:.3f}, all {grown['peak']:.3f}",
            YES if max(grown.values()) <= MOST_GROWTH else NO,
        ),
    ]


def _command_rows(commands: Report) -> list[Row]:
    return [_command_row(row) for row in commands["commands"]]


def _command_row(row: Report) -> Row:
    target = f"< {row['asked_s']:g} s"
    if row["exit_code"]:
        return Row(row["title"], target, f"exit code {row['exit_code']}", NO)
    measured = f"{row['wall_s']:.2f} s (CPU {row['cpu_s']:.2f})"
    met = judge(row["part_of_asked"] < 1.0, row["cpu_part_of_asked"] < 1.0, row["others_cores"])
    return Row(row["title"], target, measured, met)


def _honesty_rows(honesty: Report) -> list[Row]:
    """Rows for each set as a whole; the gain has a target only for the set of phones."""
    rows: list[Row] = []
    for entry in honesty["summary"]:
        if entry["capture"] is not None:
            continue
        title, least = f"{entry['set']}, {entry['preset']}", LEAST_PHONE_GAIN_DB[entry["preset"]]
        gain, worse, off = (entry[key] for key in ("mean_gain_db", "worse_share", "promise_off"))
        target, met = (f">= {least:g} dB", YES if gain >= least else NO) if entry["set"] == "phone" else (OPEN, OPEN)
        rows.append(Row(f"{title}: mean gain", target, f"{gain:+.2f} dB", met))
        rows.append(Row(f"{title}: frames made worse", "none", f"{percent(worse)}, worst {entry['worst_db']:+.2f} dB",
                        NO if worse else YES))  # fmt: skip
        if off is not None:
            met = YES if off <= MOST_PREDICTION_OFF_DB else NO
            rows.append(
                Row(f"{title}: |predicted - measured gain|", f"<= {MOST_PREDICTION_OFF_DB:g} dB", f"{off:.2f} dB", met)
            )
    return rows


SECTIONS: dict[str, Callable[[Report], list[Row]]] = {
    "speed": _speed_rows,
    "growth": _growth_rows,
    "memory": _memory_rows,
    "commands": _command_rows,
    "honesty": _honesty_rows,
}
