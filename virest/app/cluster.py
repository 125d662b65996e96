"""Run segments on a Dask cluster: an executor over ``Client.get_executor()`` with readable errors.

Dask itself moves a segment to another worker if its worker dies, and gives up after several deaths.  This module checks
the workers before any work, knows how many segments keep them busy, detects that the scheduler or all workers are gone,
and waits at exit until no worker writes any more.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
import uuid
from collections.abc import Callable
from concurrent.futures import Executor, Future
from importlib.metadata import version
from pathlib import Path
from typing import Any

from virest import __version__
from virest.capture.location import is_remote
from virest.errors import RestorationError, SettingsError, one_line
from virest.image_formation import transforms

log = logging.getLogger(__name__)

CONNECT_S = 10.0
CONNECT_VARIABLE = "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT"
"""How long to wait for an answer, and Dask's own variable that overrides it."""
FIRST_WORKER_S = 30.0
"""How long to wait for a cluster's first worker, and for one to return after all are lost."""
LOOK_S = 2.0
"""Maximum age of the cached worker count."""
LAST_SEGMENT_S = 120.0
"""How long to wait at exit for segments in progress."""
VERBOSE_LOGGERS = ("distributed", "tornado", "asyncio")
"""Loggers that report a lost connection in many lines."""
LIBRARIES = ("numpy", "opencv-python-headless", "av", "deflate")
"""Libraries that determine the bytes of a picture."""
TRANSFORMS = "transforms by"
"""The library of tiles' Fourier transforms, which follows from OpenCV's build and the environment."""


def is_lost(error: BaseException) -> bool:
    """Whether an error means that the scheduler or every worker is lost, so that no capture can be processed."""
    return isinstance(error, RestorationError) and bool(error.facts.get("cluster_lost"))


def worker_facts() -> dict[str, str]:
    """Versions installed on the machine that calls this."""
    return {"virest": __version__, **{name: version(name) for name in LIBRARIES}, TRANSFORMS: transforms.in_use()}


def missing_paths(paths: list[str]) -> list[str]:
    """Those of the paths that do not exist on the machine that calls this."""
    return [path for path in paths if not Path(path).exists()]


def _being_worked_on(run: str, dask_worker: Any) -> int:
    return sum(str(key).startswith(run) for key in dask_worker.active_threads.values())


class ClusterExecutor(Executor):
    """Submits work to the workers of a Dask scheduler. Raises SettingsError if they cannot do it."""

    def __init__(self, address: str, *, verbose: bool = False) -> None:
        self.address = address
        self._run = f"virest-{uuid.uuid4().hex[:12]}"
        self._sent = 0
        self._client = _connect(address, verbose)
        self._executor = self._client.get_executor(pure=False)
        self._looked_s, self._slots = 0.0, 0
        self._alone_since_s: float | None = None
        try:
            self._require_same_versions()
        except BaseException:
            self._client.close(timeout=_connect_s())
            raise

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Send a call to a worker. The future is cancelled if the scheduler is lost."""
        self._sent += 1
        key = f"{self._run}-{self._sent}"
        try:
            return self._executor.submit(fn, *args, key=key, **kwargs)  # type: ignore[no-any-return]
        except Exception as error:  # Dask raises its own type for a closed client
            raise self.lost() from error

    @property
    def slots(self) -> int:
        """Segments in flight: one per worker thread, plus one per worker to cover the transfer of results."""
        if time.monotonic() - self._looked_s > LOOK_S:
            threads = self._threads()
            self._slots = max(sum(threads.values()) + len(threads), 2)
            self._looked_s = time.monotonic()
        return self._slots

    def check(self) -> None:
        """Raise RestorationError if no worker has been connected for FIRST_WORKER_S."""
        if self._threads():
            self._alone_since_s = None
            return
        if self._alone_since_s is None:
            self._alone_since_s = time.monotonic()
            log.warning("the scheduler %s has no workers; waiting %.0f s for one", self.address, FIRST_WORKER_S)
        if time.monotonic() - self._alone_since_s > FIRST_WORKER_S:
            raise RestorationError(
                f"the scheduler {self.address} has had no workers for {FIRST_WORKER_S:.0f} s",
                hint="start workers, then continue with --resume",
                cluster_lost=True,
            )

    def lost(self) -> RestorationError:
        """The error for a scheduler that no longer answers."""
        return RestorationError(
            f"lost the scheduler {self.address}; finished segments are kept",
            hint="restart it, then continue with --resume",
            cluster_lost=True,
        )

    def require_paths(self, places: list[Path]) -> None:
        """Raise SettingsError unless every worker sees these files and folders of a shared disk."""
        shared = [str(place.absolute()) for place in places if not is_remote(place)]
        if not shared:
            return
        for worker, missing in self._ask(missing_paths, shared).items():
            if missing:
                raise SettingsError(
                    f"the worker {worker} does not see {missing[0]}",
                    hint="put captures and --out on a disk that all workers share, or at an address such as s3://",
                )

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Disconnect from the cluster after its workers have stopped writing for this run."""
        if self._client.status == "running":
            self._executor.shutdown(wait=wait and not cancel_futures)
            self._await_last()
        self._client.close(timeout=_connect_s())

    # ── asking ───────────────────────────────────────────────────────────────────────────────────────────────────

    def _threads(self) -> dict[str, int]:
        """Threads of each worker, as the scheduler knows them."""
        try:
            if self._client.status == "running":
                return dict(self._client.sync(self._client.scheduler.ncores, callback_timeout=_connect_s()))
        except OSError as error:
            raise self.lost() from error
        raise self.lost()

    def _ask(self, fn: Callable[..., Any], *args: Any) -> dict[str, Any]:
        try:
            return dict(self._client.run(fn, *args))
        except Exception as error:  # an error of the worker, or of Dask itself
            raise SettingsError(
                f"--scheduler {self.address}: a worker cannot do the work: {type(error).__name__}: {one_line(error)}",
                hint=f"install virest {__version__} with its extra [cluster] on every worker",
            ) from error

    def _require_same_versions(self) -> None:
        """Refuse workers with another virest version; warn if a library version differs."""
        ours = worker_facts()
        for worker, theirs in self._ask(worker_facts).items():
            if theirs["virest"] != ours["virest"]:
                raise SettingsError(
                    f"--scheduler {self.address}: the worker {worker} has virest {theirs['virest']}, this "
                    f"machine {ours['virest']}",
                    hint="install the same version everywhere",
                )
            other = [
                f"{name} {theirs[name]}, here {ours[name]}"
                for name in (*LIBRARIES, TRANSFORMS)
                if theirs[name] != ours[name]
            ]
            if other:
                log.warning("the worker %s has %s: output bytes may differ from a local run", worker, "; ".join(other))

    def _await_last(self) -> None:
        """Wait for segments in progress: a worker still completes a cancelled segment."""
        end_s = time.monotonic() + LAST_SEGMENT_S
        while time.monotonic() < end_s:
            try:
                if not any(self._client.run(_being_worked_on, self._run, on_error="ignore").values()):
                    return
            except Exception:  # the scheduler has exited: nothing left to query
                return
            time.sleep(0.1)
        log.warning("a worker is still writing a cancelled segment; wait before using --overwrite")


def _connect_s() -> float:
    from dask.utils import parse_timedelta

    return float(parse_timedelta(os.environ.get(CONNECT_VARIABLE, CONNECT_S)))


def _connect(address: str, verbose: bool) -> Any:
    import dask
    from dask.distributed import Client

    if not verbose:  # virest reports a lost connection in one line of its own
        for name in [*logging.root.manager.loggerDict, *VERBOSE_LOGGERS]:  # Dask sets levels on some child loggers
            if name.partition(".")[0] in VERBOSE_LOGGERS:
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        dask.config.set({"distributed.comm.timeouts.connect": f"{_connect_s()}s"})
        asyncio.run(_try_connection(address))  # a client that fails to connect logs many lines when it is closed
        client = Client(address, timeout=_connect_s(), set_as_default=False)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise SettingsError(
            f"--scheduler {address}: {one_line(error)}", hint="start `dask scheduler`, or omit --scheduler"
        ) from error
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
    except OSError:
        client.close(timeout=_connect_s())
        raise SettingsError(
            f"--scheduler {address}: has no workers", hint=f"start some: dask worker {address} --nthreads 1"
        ) from None
    return client


async def _try_connection(address: str) -> None:
    from distributed.comm import connect

    comm = await connect(address, timeout=_connect_s())
    await comm.close()
