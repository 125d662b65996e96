"""``virest criticise residuals.csv``: structure in a calibration's residuals that its model does not explain."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from virest.app.field_record import field_record
from virest.app.outputs import plain
from virest.diagnosis.field.residual_table import NEEDED, QUANTITY, Criticism, TableFinding, criticise
from virest.diagnosis.findings import HeldOutGain
from virest.errors import CaptureError

Json = dict[str, Any]
SCHEMA = "virest/criticism/1"
MAX_BYTES = 1 << 30
"""The table is held in memory."""
NAMES = ",".join(NEEDED)
SEPARATORS = (";", "\t", ",")


def criticise_file(path: Path) -> tuple[Json, str]:
    """Facts for ``--json`` and the printed text. Raises CaptureError if the table cannot be used."""
    columns = read_columns(path)
    try:
        found = criticise(columns)
    except CaptureError as error:
        raise CaptureError(f"{path.name}: {error.message}", hint=error.hint) from None
    return as_json(path, found), describe(path, found)


def read_columns(path: Path) -> dict[str, Any]:
    """The numeric columns of a table by name, in lower case.

    Columns are separated by commas, semicolons, tabs or blanks; a decimal comma is accepted if commas do not separate
    columns.  `#` begins a comment; the line of names may begin with one, as in vnlog files (mrcal).
    """
    if not path.is_file():
        raise CaptureError(f"{path}: no such file", hint="pass a CSV file with the columns x, y, dx, dy")
    if path.stat().st_size > MAX_BYTES:
        raise CaptureError(f"{path.name}: larger than {MAX_BYTES >> 20} MB", hint="keep fewer rows")
    try:
        legend, skipped, first = _beginning(path)
        separator = next((mark for mark in SEPARATORS if mark in legend), r"\s+")
        names = [name.strip(' "').lower() for name in re.split(separator, legend.strip())]
        if all(map(_is_number, names)):
            raise CaptureError(f"{path.name}: its first line holds numbers", hint=f"name the columns: {NAMES}, ...")
        if len(set(names)) < len(names):
            raise CaptureError(f"{path.name}: a column name occurs twice", hint="give each column its own name")
        decimal = "," if separator in ";\t" and re.search(r"\d,\d", first) else "."
        table = pd.read_csv(
            path, sep=separator, names=names, skiprows=skipped, decimal=decimal, skipinitialspace=separator == ",",
            comment="#", encoding="utf-8-sig", index_col=False,
        )  # fmt: skip
    except (ValueError, UnicodeDecodeError, OSError) as error:
        reason = (str(error).splitlines() or ["empty"])[0][:120]
        raise CaptureError(f"{path.name}: not a CSV table: {reason}", hint=f"first line: {NAMES}") from None
    numeric = {name: pd.to_numeric(table[name], errors="coerce").to_numpy(float) for name in table.columns}
    columns = {name: values for name, values in numeric.items() if np.isfinite(values).any()}
    if missing := [name for name in NEEDED if name not in columns]:
        found = ", ".join(name for name in columns if name.isprintable())[:80] or "no column with numbers"
        raise CaptureError(
            f"{path.name}: no column {', '.join(missing)}; it has {found}",
            hint=_nearest(columns) or f"the columns {', '.join(NEEDED)} are needed, in pixels",
        )
    return columns


def _beginning(path: Path) -> tuple[str, int, str]:
    """The line of names, its number from 1, and the line after it. Raises ValueError for an empty file."""
    with path.open(encoding="utf-8-sig") as lines:
        for number, line in enumerate(lines, start=1):
            words = line.lstrip("# \t").rstrip()
            is_legend = set(NEEDED) <= set(re.split(r"[\s,;]+", words.lower()))
            if words and (is_legend or not line.startswith("#")):
                return words, number, next(lines, "")
    raise ValueError("no line of names")


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _nearest(columns: dict[str, Any]) -> str:
    """A hint: existing columns that may be meant by the missing ones."""
    missing = [name for name in NEEDED if name not in columns]
    spare = [name for name in columns if name not in NEEDED]
    near = [
        [s for s in spare if s.startswith(name)][:1] or difflib.get_close_matches(name, spare, n=1, cutoff=0.4)
        for name in missing
    ]
    pairs = [f"'{found[0]}' for '{name}'" for name, found in zip(missing, near, strict=True) if found]
    return f"rename {', '.join(pairs)}?" if pairs else ""


def as_json(path: Path, found: Criticism) -> Json:
    """The findings as one object."""
    content = {
        "schema": SCHEMA,
        "file": path.name,
        "rows": found.rows,
        "used": found.used,
        "rms_px": found.rms_px,
        "left_px": found.left_px,
        "false_alarm_rate": found.false_alarm_rate,
        "asked": list(found.forms),
        "fields": [_field(field) for field in found.findings],
    }
    facts: Json = plain(content)
    return facts


def _field(field: TableFinding) -> Json:
    held_out = HeldOutGain(QUANTITY, field.before, field.after, field.noise)
    knots, values = ([list(one) for one in many] for many in (field.knots, field.values))
    return field_record(field, held_out, knots=knots, values=values, figure=None)


def describe(path: Path, found: Criticism) -> str:
    """The findings as printed text."""
    over = [form.split(" over ")[1].split(", ") for form in found.forms]
    asked = ", ".join(dict.fromkeys(name for names in over for name in names if name != "radius"))
    pairs = " and pairs of these" if any(len(names) > 1 and names != ["x", "y"] for names in over) else ""
    lines = [
        f"{path.name}: {found.rows} residuals ({found.used} used), {found.rms_px:.3g} px rms per coordinate",
        f"tested covariates: {asked}{pairs}",
    ]
    for field in found.findings:
        lines.append(f"field: {field.sentence}; largest value ± {field.std:.2g} {field.unit}")
        lines.append(f"  likely: {field.reasons}; to confirm: {field.next}")
    left = f"{found.left_px:.3g} px"
    if found.findings:
        lines.append(f"remaining: {left} without structure")
    else:
        lines.append(f"no structure found (false-alarm rate {found.false_alarm_rate:g} for all covariates together)")
    return "\n".join(lines)
