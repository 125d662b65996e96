"""The program on systems without fcntl, signal masks and SIGHUP, and its message when it is interrupted."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from virest.app import cli, console

WITHOUT = """
import concurrent.futures, multiprocessing, signal, subprocess, sys, types
sys.modules["fcntl"] = None
locked = []
sys.modules["msvcrt"] = types.SimpleNamespace(LK_NBLCK=2, locking=lambda handle, mode, length: locked.append(length))
del signal.pthread_sigmask, signal.SIGHUP
import virest.app.cli
from virest.app import run_folder
from virest.app.worker_processes import submit_uninterrupted
from pathlib import Path

with run_folder._locked(run_folder.RunFolder(Path(sys.argv[1]))):
    assert locked == [1]
with concurrent.futures.ThreadPoolExecutor(1) as pool:
    assert submit_uninterrupted(pool, abs, -3).result() == 3
sys.argv = ["virest", "--version"]
virest.app.cli.main()
"""


def test_the_program_starts_on_a_system_without_unix_calls(tmp_path: Path) -> None:
    """Windows locks a run's folder with msvcrt and lacks some of the signals."""
    done = subprocess.run([sys.executable, "-c", WITHOUT, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "virest" in done.stdout


@pytest.mark.parametrize(("command", "goes_on"), [("process", True), ("calibrate", False), ("diagnose", False)])
def test_only_process_mentions_resume(monkeypatch: pytest.MonkeyPatch, command: str, goes_on: bool) -> None:
    """Other commands cannot be resumed."""
    said: list[str] = []

    monkeypatch.setattr(console.CONSOLE, "line", said.append)
    monkeypatch.setattr(cli, "program", _Interrupted)
    assert cli.run([command, "somewhere"]) == cli.INTERRUPTED
    assert ("--resume" in said[0]) is goes_on


class _Interrupted:
    def make_context(self, *_: object) -> None:
        raise KeyboardInterrupt


def test_a_batch_in_which_all_captures_fail_exits_with_9(virest, tmp_path: Path) -> None:
    """One capture gives its own code; two give 9 even if both fail."""
    nothing = [tmp_path / "a", tmp_path / "b"]
    assert virest("process", nothing[0], "--out", tmp_path / "out").returncode == 4
    assert virest("process", *nothing, "--out", tmp_path / "out").returncode == 9
    assert virest("inspect", *nothing).returncode == 9
