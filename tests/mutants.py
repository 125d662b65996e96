"""Find small faults that no fast test notices, with random mutants (Cosmic Ray) judged by the tests of their lines.

    make mutants ARGS="--rooms image_formation --count 40 --seed 1"

A room's fast tests run once under coverage, which gives the tests of each line and the time that each test takes.
The quickest of them then judge a mutant, up to a time limit.  The program works on a copy of the last commit.
"""

from __future__ import annotations

import argparse
import os
import sqlite3
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from coverage import CoverageData
from tqdm import tqdm

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("image_formation", "restoration", "diagnosis")
TELLING = {"Add", "Sub", "Mul", "Div", "Pow", "Lt", "LtE", "Gt", "GtE", "Eq", "NotEq"}
"""Operands of the replacements tried. Changing a product to a bit shift, for example, fails at once."""
OTHERS = {"NumberReplacer", "AddNot", "ReplaceUnaryOperator_Delete_USub", "ReplaceBreakWithContinue"}
OTHERS |= {"ReplaceOrWithAnd", "ReplaceAndWithOr", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue"}
TRACED = 2.0
"""Approximate factor by which coverage slows a test down."""


@dataclass(frozen=True)
class Mutant:
    """One small fault."""

    path: str
    line: int
    operator: str
    occurrence: int


def main() -> None:
    """Sample mutants of some rooms and print those that no test notices."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", nargs="+", default=ROOMS)
    parser.add_argument("--count", type=int, default=40, help="mutants of each room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0, help="time of the tests that judge one mutant")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "virest"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(copy)], check=True)
        for room in chosen.rooms:
            by_line, seconds = covering_tests(copy, room)
            sample = sampled(copy, room, chosen.count, chosen.seed)
            print_room(room, sample, list(judged(copy, sample, by_line, seconds, chosen.seconds)))


def covering_tests(copy: Path, room: str) -> tuple[dict[tuple[str, int], set[str]], dict[str, float]]:
    """The fast tests of a room by (file, line), and the seconds that each takes."""
    options = ["-m", "not scenario", "-n", "0", "--cov-context=test", "--cov-report=", "--junitxml=times.xml"]
    run(copy, [f"tests/{room}", f"--cov=virest/{room}", *options], timeout=None)
    data = CoverageData(str(copy / ".coverage"))
    data.read()
    by_line = {
        (os.path.relpath(path, copy), line): {context.split("|")[0] for context in contexts if context}
        for path in data.measured_files()
        for line, contexts in data.contexts_by_lineno(path).items()
    }
    seconds = {}
    for case in ElementTree.parse(copy / "times.xml").iter("testcase"):
        path = case.attrib["classname"].replace(".", "/") + ".py"
        seconds[f"{path}::{case.attrib['name']}"] = float(case.attrib["time"]) / TRACED
    return by_line, seconds


def sampled(copy: Path, room: str, count: int, seed: int) -> list[Mutant]:
    """Some of a room's mutants, in proportion to the number in each file."""
    config, session = copy / "mutants.toml", copy / "mutants.sqlite"
    config.write_text(
        f'[cosmic-ray]\nmodule-path = "virest/{room}"\ntimeout = 1.0\nexcluded-modules = []\ntest-command = "true"\n'
        '[cosmic-ray.distributor]\nname = "local"\n'
    )
    session.unlink(missing_ok=True)
    subprocess.run(["cosmic-ray", "init", config.name, session.name], cwd=copy, check=True, capture_output=True)
    with sqlite3.connect(session) as data:
        rows = data.execute(
            "select module_path, start_pos_row, operator_name, occurrence from mutation_specs order by 1, 2, 3, 4"
        ).fetchall()
    telling = [Mutant(*row) for row in rows if is_telling(row[2].removeprefix("core/"))]
    drawn = np.random.default_rng(seed).permutation(len(telling))[:count]
    return [telling[number] for number in sorted(drawn)]


def is_telling(operator: str) -> bool:
    """Whether a mutation of this kind is a fault that a person could make."""
    _, *operands = operator.split("_")
    return operator in OTHERS or (len(operands) == 2 and set(operands) <= TELLING)


def judged(
    copy: Path, mutants: list[Mutant], by_line: dict[tuple[str, int], set[str]], seconds: dict[str, float], limit: float
) -> Iterator[tuple[str, str]]:
    """(verdict, difference) of each mutant."""
    for mutant in tqdm(mutants, unit="mutant", file=sys.stderr):
        tests, time = [], 0.0
        covering = by_line.get((mutant.path, mutant.line), set()) & seconds.keys()
        for name in sorted(covering, key=lambda one: (seconds[one], one)):
            if tests and time + seconds[name] > limit:
                break
            tests.append(name)
            time += seconds[name]
        change = ["cosmic-ray", "apply", mutant.path, mutant.operator, str(mutant.occurrence)]
        subprocess.run(change, cwd=copy, check=True, capture_output=True)
        difference = subprocess.run(
            ["git", "diff", "--unified=0", mutant.path], cwd=copy, check=True, capture_output=True, text=True
        ).stdout
        killed = bool(tests) and run(copy, ["-x", "-n", "0", *tests], timeout=10 * limit + 60) != 0
        subprocess.run(["git", "checkout", "--quiet", mutant.path], cwd=copy, check=True)
        yield ("killed" if killed else "survived" if tests else "run by no fast test"), difference


def run(copy: Path, arguments: list[str], timeout: float | None) -> int:
    """Run pytest in the copy; a mutant that takes too long counts as noticed."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
    threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    environment = {**os.environ, **threads, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        return subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, timeout=timeout, check=False
        ).returncode
    except subprocess.TimeoutExpired:
        return 1


def print_room(room: str, mutants: list[Mutant], verdicts: list[tuple[str, str]]) -> None:
    """Print the number of mutants with each verdict, and each mutant that was not noticed."""
    counts = {kind: sum(verdict == kind for verdict, _ in verdicts) for kind in sorted({v for v, _ in verdicts})}
    print(f"{room}: {len(mutants)} mutants: " + ", ".join(f"{count} {kind}" for kind, count in counts.items()))
    for mutant, (verdict, difference) in zip(mutants, verdicts, strict=True):
        if verdict != "killed":
            lines = [line for line in difference.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")]
            print(f"\n{mutant.path}:{mutant.line} {verdict}\n" + "\n".join(lines), flush=True)
    print()


if __name__ == "__main__":
    main()
