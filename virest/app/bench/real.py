"""Results of process, calibrate and diagnose on real captures, in the folder named by VIREST_REALDATA."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

from virest.app.bench.calibration import calibrate_folder
from virest.app.bench.workload import Scale, real_captures, run_process
from virest.app.console import numeric_table
from virest.app.diagnose import climb_as_command, open_source
from virest.diagnosis.findings import Diagnosis
from virest.diagnosis.geometric_findings import shown
from virest.errors import VirestError

log = logging.getLogger(__name__)

PROCESSED = ("lhaippp_car", "honor_v10", "nexus5_162941", "gopro_karma", "gopro_hero7")
CALIBRATED = {"lhaippp_car": (), "nexus5_162941": ("clock-skew",), "gopro_karma": (), "gopro_hero7": ()}
DIAGNOSED = ("lhaippp_car", "nexus5_162941", "honor_v10", "gopro_hero7")
PRESET, COUNTED = "fast", ("deblurred", "straightened", "copied", "skipped", "failed")
ON_TIME = ("nexus5_162941",)
"""Captures that are also diagnosed with the time offset set to 0, to be found by the diagnosis."""
Row = list[str]


def real_section(work: Path, _scale: Scale) -> tuple[dict[str, Any], str]:
    """Process, calibrate and diagnose the available captures."""
    root = real_captures()
    if root is None:
        return {
            "skipped": "VIREST_REALDATA names no folder"
        }, "Measured captures: skipped, VIREST_REALDATA names no folder"
    processed = [_processed(root / name, work) for name in PROCESSED]
    calibrated = [row for name, extra in CALIBRATED.items() for row in _calibrated(root / name, extra)]
    diagnosed = [row for name in DIAGNOSED for row in _diagnosed(root / name)]
    diagnosed += [row for name in ON_TIME for row in _diagnosed(root / name, offset_s=0.0)]
    text = numeric_table(["process", "frames", *COUNTED, "verdict"], processed)
    text += "\n\n" + numeric_table(["calibrate", "value", "found", "std", "determined"], calibrated)
    text += "\n\n" + numeric_table(
        ["diagnose", "verdict", "cause", "found", "std", "before", "after", "rivals"], diagnosed
    )
    title = f"Measured captures, process with preset {PRESET}"
    return {"process": processed, "calibrate": calibrated, "diagnose": diagnosed}, f"{title}\n{text}"


def _processed(folder: Path, work: Path) -> Row:
    """Frame counts and verdict from run.json."""
    run = run_process(folder, work / "real", "--preset", PRESET)
    account = json.loads((run.folder / "run.json").read_text(encoding="utf-8"))
    verdict = account["verdict"].partition(":")[0]
    return [folder.name, str(len(run.lines)), *(str(account["counts"][name]) for name in COUNTED), verdict]


def _calibrated(folder: Path, extra: tuple[str, ...]) -> list[Row]:
    try:
        found = calibrate_folder(folder, extra)
    except VirestError as error:
        log.info("%s", error)
        return [[folder.name, "refused", "", "", ""]]
    wanted = [value for value in found.values if value.name in ("time_offset_s", "readout_time_s", "clock_skew")]
    return [
        [folder.name, v.name, shown(v.value), "" if v.std is None else shown(v.std), "yes" if v.determined else "no"]
        for v in wanted
    ]


def _diagnosed(folder: Path, offset_s: float | None = None) -> list[Row]:
    source = open_source(folder)
    profile, name = source.profile, folder.name
    if offset_s is not None:
        profile, name = replace(profile, time_offset_s=offset_s), f"{name}, offset given as {offset_s:g}"
    return _rows(name, climb_as_command(replace(source, profile=profile)))


def _rows(name: str, found: Diagnosis) -> list[Row]:
    rows = [
        [
            name, found.verdict, cause.name, shown(change.estimate), "" if change.std is None else shown(change.std),
            shown(cause.held_out.before), shown(cause.held_out.after), ", ".join(r.name for r in cause.rivals),
        ]
        for cause in found.causes
        for change in list(cause.parameters.values())[:1]
    ]  # fmt: skip
    return rows or [[name, found.verdict, "none", "", "", "", "", ""]]
