"""Diagnose and calibrate captures with one defect each: expected are a verdict or a one-line error, no traceback."""

from __future__ import annotations

import shutil
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from virest.app.bench.workload import Scale, real_captures, simulated
from virest.app.calibrate import CalibrationOutput, plan_calibration, run_calibration
from virest.app.console import numeric_table
from virest.app.diagnose import DiagnosisOptions, run_diagnosis
from virest.errors import VirestError

LOGS = ("gyro_accel.csv", "movie_metadata.csv", "frame_timestamps.txt")
FILLINGS = {"null": "null", "zero": "0", "huge": "1e9", "first": None}
"""Values that replace a column; None: its first value."""
CUT_PARTS = {"its first tenth": (0.1, 1.0), "its second half": (0.0, 0.5), "its middle": None}
"""Row ranges to keep, as fractions; None: all but the middle fifth."""
Defect = Callable[[Path], None]


def broken_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Apply every defect to simulated captures, with --full also to available real ones, and count the outcomes."""
    sources = [
        simulated(work, "broken-source", width=240, height=320, frames=24, seed=3, rate_rad_s=1.0, exposure_ms=8),
        simulated(work, "broken-rest", width=240, height=320, frames=24, seed=4, rate_rad_s=0.0),
    ]
    sources += _measured() if scale.full else []
    rows = [
        {"capture": source.name, "broken": name, **outcomes(work, source, defect)}
        for source in sources
        for name, defect in defects(source)
    ]
    faults = [row for row in rows if "fault" in (row["diagnose"], row["calibrate"])]
    header = ["capture", "broken", "diagnose", "calibrate"]
    text = numeric_table(header, [[row[key] for key in header] for row in rows])
    return {
        "rows": rows,
        "faults": len(faults),
    }, f"Captures with one defect each\n{text}\n{len(faults)} tracebacks in {len(rows)}"


def _measured() -> list[Path]:
    """Available real captures."""
    root = real_captures()
    return [] if root is None else sorted(movie.parent for movie in root.glob("*/movie.mp4"))


def outcomes(work: Path, source: Path, defect: Defect) -> dict[str, str]:
    """Outcomes of diagnose and calibrate on a broken copy of a capture: a verdict, ``refused`` or ``fault``."""
    folder = work / f"broken-{source.name}"
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("truth*"))
    try:
        defect(folder)
        output = CalibrationOutput(work / "broken.yaml", overwrite=True)
        found = {
            "diagnose": _outcome(
                lambda: run_diagnosis(str(folder), DiagnosisOptions(work / "out", None, True)).verdict
            ),
            "calibrate": _outcome(lambda: str(run_calibration(plan_calibration(folder), output)[0]["verdict"])),
        }
    finally:
        shutil.rmtree(folder)
    return found


def _outcome(call: Callable[[], str]) -> str:
    try:
        return call()
    except VirestError:
        return "refused"
    except Exception:  # unexpected exceptions are what this section counts
        traceback.print_exc()
        return "fault"


def defects(source: Path) -> Iterator[tuple[str, Defect]]:
    """Name of each defect and the function that applies it, for the files of a capture."""
    for log in (source / name for name in LOGS):
        if not log.exists():
            continue
        yield f"no {log.name}", partial(_remove, log.name)
        yield f"{log.name}: empty", partial(_keep_rows, log.name, 0.0, 0.0)
        for name, part in CUT_PARTS.items():
            yield f"{log.name} without {name}", partial(_without_rows, log.name, part)
        for number, column in enumerate(_header(log)):
            for filling, text in FILLINGS.items():
                yield f"{log.name}: {column} {filling}", partial(_fill, log.name, number, text)
    yield "no camera.yaml", partial(_remove, "camera.yaml")


def _header(log: Path) -> list[str]:
    head = log.read_text(encoding="utf-8").splitlines()[0]
    return [cell.strip() for cell in head.split(",")]


def _remove(name: str, folder: Path) -> None:
    (folder / name).unlink(missing_ok=True)


def _without_rows(name: str, part: tuple[float, float] | None, folder: Path) -> None:
    if part is not None:
        _keep_rows(name, *part, folder)
        return
    head, rows = _rows(folder / name)
    _write(folder / name, head, rows[: 2 * len(rows) // 5] + rows[3 * len(rows) // 5 :])


def _keep_rows(name: str, begin: float, end: float, folder: Path) -> None:
    head, rows = _rows(folder / name)
    _write(folder / name, head, rows[round(begin * len(rows)) : round(end * len(rows))])


def _fill(name: str, number: int, text: str | None, folder: Path) -> None:
    head, rows = _rows(folder / name)
    cells = [row.split(",") for row in rows]
    filling = cells[0][number] if text is None else text
    filled = [",".join([*row[:number], filling, *row[number + 1 :]]) for row in cells]
    _write(folder / name, head, filled)


def _rows(log: Path) -> tuple[str, list[str]]:
    head, *rows = log.read_text(encoding="utf-8").splitlines()
    return head, rows


def _write(log: Path, head: str, rows: list[str]) -> None:
    log.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
