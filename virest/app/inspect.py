"""The command `virest inspect`: what a capture holds and what is wrong with it, before any processing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from virest.capture.detect import partial_readers
from virest.capture.files import is_present
from virest.capture.folder import EPOCHS, Capture, Frame, Note, read_capture, resolve_profile
from virest.capture.join import median_period_s
from virest.capture.video import MovieIndex
from virest.errors import CaptureError, VirestError
from virest.inference.doubtful_log import doubts

DROPPED = " dropped: "
NOT_APPLIED_S = 1e-6
"""Timestamps are logged in whole microseconds."""


def inspect_capture(path: Path) -> tuple[dict[str, Any], str, int]:
    """(JSON mapping, printed table, exit code) of one folder; errors become notes, and the code 4 if it is unusable."""
    try:
        capture = read_capture(path)
    except CaptureError as fault:
        facts = _partial(Path(path), fault)
        return facts, _describe(facts), fault.exit_code
    facts = as_json(capture)
    return facts, _describe(facts), 0


def as_json(capture: Capture) -> dict[str, Any]:
    """List a capture's facts, times in seconds from stamp_0, None for unknown; plain JSON without NaN."""
    frame_s = np.array([frame.time_s for frame in capture.frames])
    frame_period, imu_period = median_period_s(frame_s), median_period_s(capture.imu.time_s)
    logged = capture.metadata
    profile_source, profile_notes = _profile_source(capture)
    log_notes = [Note("warning", "inertial-log", f"{text}: virest diagnose") for text in doubts(capture.imu)]
    return {
        "capture": capture.name,
        "folder": str(capture.folder),
        "kind": capture.kind,
        "usable": True,
        "exit_code": 0,
        "movie": _movie(capture.width, capture.height, len(capture.frames), len(capture.keyframes)),
        "counts": {key: value for key, value in capture.counts.items() if DROPPED not in key},
        "dropped": _dropped(capture.counts),
        "frames": _frame_counts(capture.frames),
        "clock": _clock(capture.clock_source, capture.clock_shift_ns, capture.clock_difference_ns),
        "span_s": {
            "frames": [float(frame_s[0]), float(frame_s[-1])],
            "imu": [float(capture.imu.time_s[0]), float(capture.imu.time_s[-1])],
        },
        "rate_hz": {
            "frames": 1 / frame_period if frame_period else None,
            "imu": 1 / imu_period if imu_period else None,
        },
        "frame_gaps": _frame_gaps(capture.frames, frame_s, frame_period),
        "imu_gaps_s": [list(gap) for gap in capture.imu_gaps_s],
        "repeats": list(capture.repeats),
        "startup_lag_s": capture.startup_lag_s,
        "stalls": [list(stall) for stall in capture.stalls],
        "skipped": _skipped(capture.frames),
        "exposure_s": _range([frame.exposure_s for frame in capture.frames]),
        "iso": _range([frame.iso for frame in capture.frames]),
        "fx_px": logged.fx_px,
        "fy_px": logged.fy_px,
        "readout_time_s": logged.readout_time_s,
        "focal_length_mm": logged.focal_length_mm,
        "accelerometer": capture.imu.has_accelerometer,
        "peak_rate_rad_s": float(np.linalg.norm(capture.imu.gyro_rad_s, axis=1).max()),
        "profile": profile_source,
        "notes": [_note(note) for note in (*capture.notes, *profile_notes, *log_notes)],
    }


# ── facts ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _movie(width: int, height: int, frames: int, keyframes: int) -> dict[str, int]:
    return {"width": width, "height": height, "frames": frames, "keyframes": keyframes}


def _frame_counts(frames: tuple[Frame, ...]) -> dict[str, Any]:
    """Number of recorded frames, of usable ones, and of unusable ones by cause."""
    codes = [code for frame in frames for code in frame.skip_codes]
    skipped = {code: codes.count(code) for code in sorted(set(codes))}
    return {"recorded": len(frames), "usable": sum(f.skip_reason is None for f in frames), "skipped": skipped}


def _clock(source: str, shift_ns: int, difference_ns: int | None) -> dict[str, Any]:
    """The shift added to the camera's timestamps, and the difference in edge_epochs.txt, applied or not."""
    difference_s = None if difference_ns is None else difference_ns / 1e9
    return {"source": source, "shift_s": shift_ns / 1e9, "edge_epochs_difference_s": difference_s}


def _note(note: Note) -> dict[str, str]:
    return {"severity": note.severity, "code": note.code, "text": note.text}


def _range(values: list[float | None]) -> list[float] | None:
    known = [value for value in values if value is not None]
    return [min(known), max(known)] if known else None


def _dropped(counts: dict[str, int]) -> dict[str, dict[str, int]]:
    """Dropped rows by file and reason."""
    found: dict[str, dict[str, int]] = {}
    for key, number in counts.items():
        name, mark, reason = key.partition(DROPPED)
        if mark:
            found.setdefault(name, {})[reason] = number
    return found


def _frame_gaps(frames: tuple[Frame, ...], frame_s: Any, period_s: float) -> list[dict[str, float]]:
    """Gaps of more than 1.5 frame periods."""
    steps = np.diff(frame_s)
    return [{"frame": frames[i + 1].index, "gap_s": float(steps[i])} for i in np.flatnonzero(steps > 1.5 * period_s)]


def _skipped(frames: tuple[Frame, ...]) -> list[dict[str, Any]]:
    """Runs of consecutive frames skipped for the same causes, with the first frame's reason."""
    runs: list[dict[str, Any]] = []
    for frame in frames:
        if frame.skip_reason is None:
            continue
        codes = list(frame.skip_codes)
        if runs and runs[-1]["last"] == frame.index - 1 and runs[-1]["codes"] == codes:
            runs[-1]["last"] = frame.index
        else:
            runs.append({"first": frame.index, "last": frame.index, "codes": codes, "reason": frame.skip_reason})
    return runs


def _profile_source(capture: Capture) -> tuple[str | None, list[Note]]:
    """Where the profile comes from, or a note of why it cannot be used."""
    try:
        return resolve_profile(capture)[1], []
    except VirestError as fault:
        return None, [Note("warning", "profile", str(fault))]


def _partial(path: Path, fault: CaptureError) -> dict[str, Any]:
    """The facts of an unusable capture: each file by itself."""
    folder = path.absolute()
    facts: dict[str, Any] = {
        "capture": folder.resolve().name if _is_folder(folder) else folder.name,
        "folder": str(folder),
        "usable": False,
        "exit_code": fault.exit_code,
        "counts": {},
        "dropped": {},
    }
    notes = [Note("error", _code(fault), str(fault))]
    if _is_folder(folder):
        readers = partial_readers(folder)
        missing = [path.name for path in readers if path.name != EPOCHS and not is_present(path)]
        for path, reader in readers.items():
            if path.name not in missing:
                _add_file(path, reader, facts, notes)
        others = [name for name in missing if name not in str(fault)]
        if others:
            notes.append(Note("error", "files-missing", f"also missing: {', '.join(others)}"))
    facts["notes"] = [_note(note) for note in notes]
    return facts


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def _code(fault: CaptureError) -> str:
    return type(fault).__name__.removesuffix("Error").lower()


def _add_file(path: Path, reader: Callable[[Path], Any], facts: dict[str, Any], notes: list[Note]) -> None:
    """Add the content of one file, or why it cannot be read."""
    try:
        found = reader(path)
    except CaptureError as fault:
        if path.name != EPOCHS and str(fault) not in [note.text for note in notes]:
            notes.append(Note("error", _code(fault), str(fault)))
        return
    if isinstance(found, MovieIndex):
        facts["movie"] = _movie(found.width, found.height, len(found), len(found.keyframes))
    elif path.name == EPOCHS:
        applied_ns = (found.mean_difference_ns or 0) if found.source == "UNKNOWN" else 0
        facts["clock"] = _clock(found.source, applied_ns, found.mean_difference_ns)
    else:
        facts["counts"][f"{path.name} rows"] = found.rows
        if found.dropped:
            facts["dropped"][path.name] = dict(found.dropped)
        if len(found.time_ns):
            span = [int(found.time_ns[0]) / 1e9, int(found.time_ns[-1]) / 1e9]
            facts.setdefault("logged_span_s", {})[path.name] = span


# ── the table ────────────────────────────────────────────────────────────────────────────────────────────────────


def _describe(facts: dict[str, Any]) -> str:
    lines = [f"{facts['capture']}: {'usable' if facts['usable'] else 'NOT usable'}"]
    for title, text in _rows(facts):
        lines.append(f"  {title:<14}{text}")
    for note in facts["notes"]:
        lines.append(f"  {note['severity']:<9}{note['code']}: {note['text']}")
    return "\n".join(lines)


def _rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """(title, text) of each line that is not empty."""
    rows: list[tuple[str, str]] = [("kind", facts["kind"])] if "kind" in facts else []
    if movie := facts.get("movie"):
        size = f"{movie['width']}x{movie['height']}"
        keys = f"{movie['keyframes']} key frame{'s' if movie['keyframes'] != 1 else ''}"
        rows.append(("movie", f"{size}, {movie['frames']} frames, {keys}"))
    rows += [("counts", text) for text in _wrapped(facts["counts"])]
    for name, reasons in facts["dropped"].items():
        rows.append(("dropped", f"{name}: " + ", ".join(f"{n} {reason}" for reason, n in reasons.items())))
    if clock := facts.get("clock"):
        text = f"source {clock['source']}, camera stamps shifted by {clock['shift_s']:.6f} s"
        difference_s = clock["edge_epochs_difference_s"]
        if difference_s is not None and abs(difference_s - clock["shift_s"]) > NOT_APPLIED_S:
            text += f" (edge_epochs.txt: the clocks differ by {difference_s:.6f} s; not needed for this source)"
        rows.append(("clock", text))
    for name, span in (facts.get("span_s") or facts.get("logged_span_s") or {}).items():
        rows.append(("span", f"{name} {span[0]:.3f} to {span[1]:.3f} s"))
    if not facts["usable"]:
        return rows
    return rows + _camera_rows(facts)


def _camera_rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    rate = facts["rate_hz"]
    rows = [("rate", f"frames {_shown(rate['frames'], '.2f')} Hz, IMU {_shown(rate['imu'], '.1f')} Hz")]
    gaps = facts["imu_gaps_s"]
    rows.append(("gaps", f"IMU {len(gaps)}, frames {len(facts['frame_gaps'])}"))
    rows += [("imu gap", f"{start:.3f} to {end:.3f} s ({(end - start) * 1e3:.0f} ms)") for start, end in gaps[:8]]
    repeats = facts["repeats"]
    rows.append(("repeats", f"frames {', '.join(map(str, repeats))}" if repeats else "none in the first 2 s"))
    rows.append(("recorder lag", f"{_shown(facts['startup_lag_s'], '.2f')} s" if facts["startup_lag_s"] else "none"))
    for run in facts["skipped"][:8]:
        rows.append(("left out", f"frames {run['first']}–{run['last']}: {run['reason']}"))
    exposure, iso = facts["exposure_s"], facts["iso"]
    rows.append(("exposure", f"{exposure[0] * 1e3:.3f} to {exposure[1] * 1e3:.3f} ms" if exposure else "unknown"))
    rows.append(("ISO", f"{iso[0]:.0f} to {iso[1]:.0f}" if iso else "unknown"))
    rows.append(("focal length", f"fx {_shown(facts['fx_px'], '.2f')}, fy {_shown(facts['fy_px'], '.2f')} px"))
    readout = facts["readout_time_s"]
    rows.append(("readout", f"{readout * 1e3:.3f} ms" if readout else "unknown"))
    rows.append(("accelerometer", "yes" if facts["accelerometer"] else "no"))
    rows.append(("peak rate", f"{facts['peak_rate_rad_s']:.2f} rad/s"))
    rows.append(("profile", facts["profile"] or "cannot be used"))
    return rows


def _shown(value: float | None, form: str) -> str:
    return "unknown" if value is None else format(value, form)


def _wrapped(counts: dict[str, int]) -> list[str]:
    parts = [f"{key} {value}" for key, value in counts.items() if value or not key.endswith("pts")]
    return [", ".join(parts[i : i + 4]) for i in range(0, len(parts), 4)]
