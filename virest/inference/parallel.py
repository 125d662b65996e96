"""Independent calls of one function, made in this process or in others; the caller need not know which."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Protocol, runtime_checkable


class ParallelMap(Protocol):
    """Calls a module-level function with each tuple of picklable arguments and lists the results in that order."""

    def __call__(
        self,
        function: Callable[..., Any],
        arguments: Iterable[tuple[Any, ...]],
        done: Callable[[int], None] | None = None,
    ) -> list[Any]:
        """done: called with the index of each finished call, in order."""


@runtime_checkable
class Background(Protocol):
    """A :class:`ParallelMap` that can also start a call without waiting for it."""

    def begin(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        """Start a call; the returned function waits for its result."""
        ...


def begun(each: ParallelMap, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """Start a call of a module-level function with picklable arguments in the background; returns its result's getter.

    Without another process, the call is made when the result is requested, or never.
    """
    if isinstance(each, Background):
        return each.begin(function, *arguments)
    return partial(function, *arguments)


def one_by_one(
    function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], done: Callable[[int], None] | None = None
) -> list[Any]:
    """Make all calls in this process, one after another."""
    results = []
    for number, parts in enumerate(arguments):
        results.append(function(*parts))
        if done is not None:
            done(number)
    return results
