"""A Dask scheduler and its workers as separate processes, as on a real cluster."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

START_S = 60


class Cluster:
    """A scheduler on a free port with workers that can be killed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.workers: list[subprocess.Popen[bytes]] = []
        self.scheduler, line = self._start(
            "scheduler", "distributed.cli.dask_scheduler", r"Scheduler at:\s+(tcp://\S+)", "--port", "0",
            "--host", "127.0.0.1", "--no-dashboard", "--dashboard-address", "127.0.0.1:0",
        )  # fmt: skip
        self.address = line

    def add_worker(self) -> None:
        """Start one more worker with one thread and without a nanny that would restart it."""
        name = f"worker-{len(self.workers)}"
        worker, _ = self._start(
            name, "distributed.cli.dask_worker", r"Registered to:", self.address, "--no-nanny", "--nthreads", "1",
            "--host", "127.0.0.1", "--no-dashboard", "--dashboard-address", "127.0.0.1:0",
            "--local-directory", str(self._folder / name),
        )  # fmt: skip
        self.workers.append(worker)

    def _start(self, name: str, module: str, ready: str, *arguments: str) -> "tuple[subprocess.Popen[bytes], str]":
        log = self._folder / f"{name}.log"
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        with log.open("wb") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", module, *arguments], stdout=file, stderr=file, env=environment
            )
        return process, wait_for_line(log, ready, process)

    def close(self) -> None:
        """Kill all processes that are still running."""
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


def wait_for_line(log: Path, pattern: str, process: "subprocess.Popen[bytes]") -> str:
    """Wait until a line of a log matches; return its first group, or the whole match."""
    import time

    end = time.monotonic() + START_S
    while True:
        if found := re.search(pattern, log.read_text(errors="replace")):
            return found.group(found.lastindex or 0)
        assert process.poll() is None, log.read_text(errors="replace")
        assert time.monotonic() < end, log.read_text(errors="replace")
        time.sleep(0.05)


@contextmanager
def running_cluster(folder: Path, workers: int) -> Iterator[Cluster]:
    """A cluster with the given number of workers, closed on exit."""
    folder.mkdir(parents=True, exist_ok=True)
    cluster = Cluster(folder)
    try:
        for _ in range(workers):
            cluster.add_worker()
        yield cluster
    finally:
        cluster.close()
