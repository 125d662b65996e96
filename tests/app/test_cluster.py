"""The same segments on a Dask cluster give the same bytes, even if a worker or the scheduler is killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from cluster_processes import Cluster, running_cluster
from run_content import content, differences

from virest.app import jobs
from virest.app.cluster import CONNECT_VARIABLE, is_lost
from virest.app.jobs import Workers
from virest.errors import RestorationError

Virest = Callable[..., "subprocess.CompletedProcess[str]"]
SLOW = ("--preset", "best", "--deblur", "wiener")
SIMULATED = "--width 180 --height 240 --frames 40 --exposure-ms 12 --rate 2 --seed 11"


def wait_until(condition: Callable[[], bool], process: "subprocess.Popen[str]") -> None:
    """Wait until a condition holds while a process runs."""
    end = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture(scope="module")
def turning(virest: Virest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated capture of 40 frames of a turning phone."""
    folder = tmp_path_factory.mktemp("captures") / "turning"
    done = virest("simulate", folder, "-q", *SIMULATED.split())
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def undisturbed(virest: Virest, turning: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Contents of a local run with one process."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    done = virest("process", turning, "--out", out, *SLOW, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    return content(out / "turning")


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """A scheduler and two workers."""
    with running_cluster(tmp_path / "cluster", 2) as found:
        yield found


def start(turning: Path, out: Path, address: str, *options: str) -> "subprocess.Popen[str]":
    """Start a run on a cluster."""
    command = [sys.executable, "-m", "virest", "process", str(turning), "--out", str(out), *SLOW]
    command += ["--scheduler", address, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finished_segments(run: Path) -> int:
    """Count the logs of segments."""
    return len(list((run / ".segments").glob("*.jsonl"))) if (run / ".segments").is_dir() else 0


@pytest.mark.scenario
def test_a_killed_worker_does_not_change_the_result(
    turning: Path, undisturbed: dict[str, Any], cluster: Cluster, tmp_path: Path
) -> None:
    """One of two workers is killed: the other processes its segments, and the folder equals that of a local run."""
    with start(turning, tmp_path / "out", cluster.address) as process:
        wait_until(lambda: finished_segments(tmp_path / "out/turning") > 0, process)
        os.kill(cluster.workers[0].pid, signal.SIGKILL)
        _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    assert differences(tmp_path / "out/turning", undisturbed) == []
    assert undisturbed["run.json"]["counts"]["restored"] > 30


@pytest.mark.scenario
def test_a_lost_scheduler_gives_one_line_and_resume_continues(
    virest: Virest, turning: Path, undisturbed: dict[str, Any], cluster: Cluster, tmp_path: Path
) -> None:
    """Exit 7; finished segments stay; a local ``--resume`` yields the files of an uninterrupted run."""
    run = tmp_path / "out/turning"
    with start(turning, tmp_path / "out", cluster.address) as process:
        wait_until(lambda: finished_segments(run) > 0, process)
        cluster.scheduler.kill()
        output, errors = process.communicate(timeout=600)
    lines = [line for line in errors.splitlines() if "error" in line.lower()]
    assert process.returncode == 7, errors
    assert "Traceback" not in errors
    assert len(lines) == 1, errors
    assert "lost the scheduler" in lines[0]
    assert "--resume" in lines[0]
    assert output == ""
    kept = finished_segments(run)
    assert kept
    again = virest("process", turning, "--out", tmp_path / "out", *SLOW, "--jobs", 2, "--resume")
    assert again.returncode == 0, again.stderr
    assert differences(run, undisturbed) == []


def test_a_wrong_address_gives_one_line(virest: Virest, tmp_path: Path) -> None:
    """Exit 3 before any input is read, after the connection timeout of Dask's own variable."""
    address = ("--scheduler", "tcp://127.0.0.1:1")
    result = virest("process", tmp_path, "--out", tmp_path / "out", *address, **{CONNECT_VARIABLE: "1200 ms"})
    assert result.returncode == 3
    assert "--scheduler tcp://127.0.0.1:1" in result.stderr
    assert "1.2 s" in result.stderr
    assert "Traceback" not in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_cancelled_job_is_not_recorded_as_failed() -> None:
    """A lost scheduler cancels submitted jobs; that is not a fault of the frames."""
    future: Future[dict[str, int]] = Future()
    future.cancel()
    future.set_running_or_notify_cancel()
    with pytest.raises(RestorationError, match="cancelled"):
        jobs._collect(future, None, Workers(1))  # type: ignore[arg-type]
    assert is_lost(RestorationError("gone", cluster_lost=True))
    assert not is_lost(RestorationError("kernel is singular"))
