"""What all tests share: real captures where there are any, the program as a process, fast tests first."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fork_server import ForkServer

ROOT = Path(__file__).resolve().parent.parent
RunVirest = Callable[..., subprocess.CompletedProcess[str]]


SHARING = {"calibrate_command", "calibrate_stories", "cluster", "evaluate_command", "evaluate_slam", "export_command",
           "export_scenes", "guided_tracking", "local_blur", "log_against_truth", "neighbours", "restoration_gain",
           "run_folder", "translation"}  # fmt: skip
"""Files whose tests share captures that take seconds to simulate: each file runs in one process."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the fast tests first, then the scenarios, the whole stories before single tests of the program."""

    def order(item: pytest.Item) -> tuple[bool, bool]:
        return item.get_closest_marker("scenario") is not None, item.path.parent.name != "scenarios"

    items.sort(key=order)
    for item in items:
        name = item.path.stem.removeprefix("test_")
        if name in SHARING:
            kind = "scenarios" if item.get_closest_marker("scenario") else "fast"
            item.add_marker(pytest.mark.xdist_group(f"{name} {kind}"))


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of the real captures; tests that need it are skipped without it."""
    folder = os.environ.get("VIREST_REALDATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("VIREST_REALDATA names no folder of real captures")
    return Path(folder)


@pytest.fixture(scope="session")
def virest() -> Iterator[RunVirest]:
    """The program as its users run it: ``virest("process", folder)`` gives returncode, stdout, stderr.

    Forked from a process that has imported it already, where that can be; with variables of its own it is started anew.
    """
    with ForkServer() as server:

        def run(
            *arguments: object, cwd: Path | None = None, stdin: str = "", timeout: float = 1200, **environment: str
        ):
            words = [*map(str, arguments)]
            if hasattr(os, "fork") and not environment:
                return server.run(words, cwd, stdin, timeout)
            return subprocess.run(
                [sys.executable, "-m", "virest", *words],
                cwd=cwd, input=stdin, capture_output=True, text=True, timeout=timeout, check=False,
                env={**os.environ, **environment},
            )  # fmt: skip

        yield run


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(20221109)
