"""Shared by all tests: real captures if available, the program as a process, and the order of tests."""

import gc
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fork_server import ForkServer

from virest.app.machine import keep_freed_memory

ROOT = Path(__file__).resolve().parent.parent
RunVirest = Callable[..., subprocess.CompletedProcess[str]]


SHARING = {"blur_length_check", "calibrate_command", "calibrate_stories", "calibration_bench", "cluster",
           "edge_overshoot", "evaluate_command", "evaluate_slam", "export_command", "export_scenes", "guided_tracking",
           "local_blur", "log_against_truth", "neighbours", "recorder_stall", "report_command", "restoration_gain",
           "run_folder", "translation", "undistort"}  # fmt: skip
"""Files whose tests share captures that take seconds to simulate: each file runs in one process."""
LONGEST = ("calibrate_stories", "real_captures", "translation", "neighbours", "pages", "fields", "diagnose_stories",
           "evaluate_slam", "diagnose_again", "diagnose_command", "cli", "urls", "crashes", "restoration_quality",
           "curve_matters")  # fmt: skip
"""Files of scenarios by their longest part in one process, 80 s to 10 s: started last, it would run alone."""


def pytest_configure() -> None:
    """Give each xdist process, and everything it starts, one core, since the processes are the parallelism.

    A program that uses all cores would start and load processes of its own in every test; tests of that behaviour ask
    for it. Freed memory is kept, as in the program. Garbage collection is off while tests are collected, which makes
    hardly any garbage. Compiled code is written even if the machine forbids it; otherwise each of the many programs
    started by the tests would compile the package anew.
    """
    gc.disable()
    keep_freed_memory()
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run fast tests first, then scenarios, the longest ones before the others."""
    rank = {f"test_{name}": k for k, name in enumerate(LONGEST)}

    def order(item: pytest.Item) -> tuple[bool, int]:
        scenario = item.get_closest_marker("scenario") is not None
        return scenario, rank.get(item.path.stem, len(rank)) if scenario else 0

    items.sort(key=order)


def pytest_collection_finish() -> None:
    """Collect garbage from here on, without the collected tests, and less often than every 700 new objects."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give a file whose tests share captures to one process, and all other tests one by one."""
    if config.getvalue("dist") != "loadgroup":
        return None
    scheduler = importlib.import_module("xdist.scheduler")

    class WholeFiles(scheduler.LoadScopeScheduling):  # type: ignore[misc, name-defined]
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.split("::")[0]
            return file if Path(file).stem.removeprefix("test_") in SHARING else nodeid

    return WholeFiles(config, log)


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of the real captures; without it the tests that need it are skipped."""
    folder = os.environ.get("VIREST_REALDATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("VIREST_REALDATA names no folder of real captures")
    return Path(folder)


@pytest.fixture(scope="session")
def fork_server() -> Iterator[ForkServer]:
    """A process that has imported the program and forks for each call."""
    with ForkServer() as server:
        yield server


@pytest.fixture(scope="session")
def virest(fork_server: ForkServer) -> RunVirest:
    """The program as its users run it: ``virest("process", folder)`` returns returncode, stdout, stderr.

    The call is forked from a process that has imported the program, if the platform can fork; with environment
    variables of its own it is started anew.
    """

    def run(*arguments: object, cwd: Path | None = None, stdin: str = "", timeout: float = 1200, **environment: str):
        words = [*map(str, arguments)]
        if hasattr(os, "fork") and not environment:
            return fork_server.run(words, cwd, stdin, timeout)
        return subprocess.run(
            [sys.executable, "-m", "virest", *words],
            cwd=cwd, input=stdin, capture_output=True, text=True, timeout=timeout, check=False,
            env={**os.environ, **environment},
        )  # fmt: skip

    return run


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(20221109)
