"""Calls distributed over processes."""

from __future__ import annotations

import math
import os
import signal
import threading
import time

import pytest

from virest.app.process_map import _ProcessPool, process_map
from virest.inference.parallel import begun, one_by_one


def die_elsewhere(parent: int, value: float) -> float:
    """End the process at once, unless it is the calling one."""
    if os.getpid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * value


def test_results_keep_the_order_of_the_calls_and_survive_a_dying_worker() -> None:
    """Two processes give what one gives. The calls of a dying worker, and all later calls, run in this process."""
    calls = [(float(k), 3.0) for k in range(7)]
    with process_map(2) as each:
        told: list[int] = []
        assert each(math.fmod, calls, told.append) == one_by_one(math.fmod, calls)
        assert told == list(range(7))
        assert set(each(os.getpid, [(), ()])) != {os.getpid()}
        assert each(die_elsewhere, [(os.getpid(), 1.5), (os.getpid(), -4.0)]) == [3.0, -8.0]
        assert each(os.getpid, [(), ()]) == [os.getpid()] * 2


def test_a_call_started_in_the_background_survives_a_dying_worker() -> None:
    """If its worker dies or has died, the call runs in this process."""
    with process_map(2) as each:
        elsewhere, doomed = begun(each, os.getpid), begun(each, die_elsewhere, os.getpid(), 1.5)
        assert elsewhere() != os.getpid()
        assert doomed() == 3.0
        assert begun(each, os.getpid)() == os.getpid()


def test_without_processes_a_call_runs_when_its_result_is_requested() -> None:
    """A call whose result is never requested does not run."""
    made = []
    with process_map(1) as each:
        first, _ = begun(each, made.append, 1), begun(each, made.append, 2)
        assert made == []
        first()
    assert made == [1]


def test_one_job_runs_in_this_process() -> None:
    """Without a second core no process is started."""
    with process_map(1) as each:
        assert each(os.getpid, [(), ()]) == [os.getpid()] * 2


def test_no_thread_of_the_pool_is_left_for_the_exit() -> None:
    """A call in progress ends first: at Python's exit its thread and Python would close the same pipe."""
    before = set(threading.enumerate())
    with process_map(2) as each:
        begun(each, time.sleep, 0.5)
    assert set(threading.enumerate()) <= before


def test_an_interruption_waits_for_no_worker() -> None:
    """Ctrl-C during long calls ends the worker processes."""
    begun = []

    def interrupted() -> None:
        with process_map(2) as each:
            assert isinstance(each, _ProcessPool)
            each._submit(time.sleep, (3600,))
            assert each._pool is not None
            begun.extend(each._pool._processes.values())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert begun
    for process in begun:
        process.join(60)
        assert not process.is_alive()
