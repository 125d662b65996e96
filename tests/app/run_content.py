"""What a run leaves, without what clocks and places decide: to be compared byte for byte."""

import json
from pathlib import Path
from typing import Any

CLOCKS = ("totals", "command")


def folder_files(run: Path) -> dict[str, bytes]:
    """All files below a folder, hidden ones too."""
    return {p.relative_to(run).as_posix(): p.read_bytes() for p in run.rglob("*") if p.is_file()}


def content(run: Path) -> dict[str, Any]:
    """Everything in a run's folder, OUT/NAME, without what a clock, the command line or the place of OUT decides."""
    files = folder_files(run)
    files["run.json"] = files["run.json"].replace(str(run.parent.parent).encode(), b".")
    return without_clocks(files)


def without_clocks(files: dict[str, bytes], *elsewhere: str) -> dict[str, Any]:
    """Files of a run without seconds, command, and the named keys of run.json; with such keys, without paths too."""
    found: dict[str, Any] = dict(files)
    lines = [json.loads(line) for line in found["parameters.jsonl"].splitlines()]
    found["parameters.jsonl"] = [{k: v for k, v in line.items() if k != "seconds"} for line in lines]
    account = json.loads(found["run.json"])
    if elsewhere:
        account["inputs"] = [{k: v for k, v in facts.items() if k != "path"} for facts in account["inputs"]]
    found["run.json"] = {k: v for k, v in account.items() if k not in (*CLOCKS, *elsewhere)}
    return found
