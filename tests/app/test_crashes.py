"""A run that is killed at any time and resumed gives the files of an uninterrupted run.

VIREST_KILLS sets the number of kills that are tried (the default is 2).
"""

import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from run_content import content, differences

Virest = Callable[..., "subprocess.CompletedProcess[str]"]
KILLS = int(os.environ.get("VIREST_KILLS", "2"))
CHANGES = ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "shutil.rmtree")
"""Audit events that change a folder, apart from opening files for writing."""
DIES = """
import os, signal, sys
place, step, left = sys.argv[1], int(sys.argv[2]), 0

def count(event, arguments):
    global left
    writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
    if (writes or event in {changes!r}) and str(arguments[0]).startswith(place):
        left += 1
        if left == step:
            os.kill(os.getpid(), signal.SIGKILL)

from virest.app.cli import run
import virest.app.process
sys.addaudithook(count)
code = run(sys.argv[3:])
print(left)
sys.exit(code)
""".replace("{changes!r}", repr(set(CHANGES)))


def run_dying(step: int, tiny: Path, out: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    """Run with one process that kills itself at its ``step``-th change of the output folder; 0 means never."""
    arguments = [str(out), str(step), "process", str(tiny), "--out", str(out), "--preset", "fast", "--jobs", "1"]
    command = [sys.executable, "-c", DIES, *arguments, "-q", *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.scenario
def test_resume_after_a_kill_at_any_folder_change_gives_the_same_run(
    virest: Virest, tiny: Path, tmp_path: Path
) -> None:
    """The steps are sampled from all changes.

    Creating folders, opening partial files, renaming them, and the final cleanup.
    """
    done = run_dying(0, tiny, tmp_path / "undisturbed")
    assert done.returncode == 0, done.stderr
    steps, expected = int(done.stdout.splitlines()[-1]), content(tmp_path / "undisturbed/tiny")
    assert steps > 24 * 2
    last = steps - 2  # the run is finished, but its temporary files still exist
    for step in {last, *random.Random(42).sample(range(1, steps + 1), min(KILLS, steps))}:
        out = tmp_path / f"killed-{step}"
        assert run_dying(step, tiny, out).returncode == -signal.SIGKILL
        again = virest("process", tiny, "--out", out, "--preset", "fast", "--jobs", "1", "-q", "--resume")
        assert again.returncode == 0, (step, again.stderr)
        assert differences(out / "tiny", expected) == [], step
        assert sorted(p.name for p in out.iterdir()) == ["tiny"]
