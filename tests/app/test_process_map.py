"""Calls shared out among processes."""

from __future__ import annotations

import math
import os
import signal
import time

import pytest

from virest.app.process_map import _ProcessPool, process_map
from virest.inference.parallel import begun, one_by_one


def die_elsewhere(parent: int, value: float) -> float:
    """End the process at once, but for the one that asks."""
    if os.getpid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * value


def test_results_come_in_the_order_of_the_calls_and_a_worker_s_death_costs_none() -> None:
    """Two processes give what one gives; the calls of a worker that dies are made here, and so are all later ones."""
    calls = [(float(k), 3.0) for k in range(7)]
    with process_map(2) as each:
        told: list[int] = []
        assert each(math.fmod, calls, told.append) == one_by_one(math.fmod, calls)
        assert told == list(range(7))
        assert set(each(os.getpid, [(), ()])) != {os.getpid()}
        assert each(die_elsewhere, [(os.getpid(), 1.5), (os.getpid(), -4.0)]) == [3.0, -8.0]
        assert each(os.getpid, [(), ()]) == [os.getpid()] * 2


def test_a_call_is_begun_beside_and_a_worker_s_death_does_not_cost_it() -> None:
    """Its result is there when asked for; if its worker dies, or has died, it is made here."""
    with process_map(2) as each:
        elsewhere, doomed = begun(each, os.getpid), begun(each, die_elsewhere, os.getpid(), 1.5)
        assert elsewhere() != os.getpid()
        assert doomed() == 3.0
        assert begun(each, os.getpid)() == os.getpid()


def test_without_processes_nothing_is_begun_before_its_result_is_wanted() -> None:
    """A call that nobody asks after costs nothing."""
    made = []
    with process_map(1) as each:
        first, _ = begun(each, made.append, 1), begun(each, made.append, 2)
        assert made == []
        first()
    assert made == [1]


def test_one_job_is_done_here() -> None:
    """Without a second core no process is started."""
    with process_map(1) as each:
        assert each(os.getpid, [(), ()]) == [os.getpid()] * 2


def test_an_interruption_waits_for_no_worker() -> None:
    """Ctrl-C in the middle of long calls ends the processes that make them."""
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
