"""Contents of a run without its clock times and paths, for byte-for-byte comparison."""

import json
from pathlib import Path
from typing import Any

CLOCKS = ("totals", "command")


def folder_files(run: Path) -> dict[str, bytes]:
    """All files below a folder, including hidden ones."""
    return {p.relative_to(run).as_posix(): p.read_bytes() for p in run.rglob("*") if p.is_file()}


def content(run: Path) -> dict[str, Any]:
    """Everything in a run's folder, OUT/NAME, except what the clock, the command line or OUT's location decides."""
    files = folder_files(run)
    files["run.json"] = files["run.json"].replace(str(run.parent.parent).encode(), b".")
    return without_clocks(files)


def without_clocks(files: dict[str, bytes], *elsewhere: str) -> dict[str, Any]:
    """A run's files without durations, the command and the named keys of run.json.

    If keys are named, paths are removed too.
    """
    found: dict[str, Any] = dict(files)
    lines = [json.loads(line) for line in found["parameters.jsonl"].splitlines()]
    found["parameters.jsonl"] = [{k: v for k, v in line.items() if k != "seconds"} for line in lines]
    account = json.loads(found["run.json"])
    if elsewhere:
        account["inputs"] = [{k: v for k, v in facts.items() if k != "path"} for facts in account["inputs"]]
    found["run.json"] = {k: v for k, v in account.items() if k not in (*CLOCKS, *elsewhere)}
    return found


def differences(run: Path, expected: dict[str, Any]) -> list[str]:
    """In what a run's content differs, by name: whole contents would fill pages if a test fails."""
    found = content(run)
    names = sorted(found.keys() | expected.keys())
    said = [f"{name}: {_change(name in expected, name in found)}" for name in names
            if found.get(name) != expected.get(name)]  # fmt: skip
    for old, new in zip(expected["parameters.jsonl"], found["parameters.jsonl"], strict=False):
        said += [f"frame {old['frame']}: {text}" for text in _changed_values(old, new)]
    return said + [f"run.json: {text}" for text in _changed_values(expected["run.json"], found["run.json"])]


def _change(expected: bool, found: bool) -> str:
    return "other content" if expected and found else "not there" if expected else "not expected"


def _changed_values(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    return [f"{key} {old.get(key)} -> {new.get(key)}" for key in old | new if old.get(key) != new.get(key)]
