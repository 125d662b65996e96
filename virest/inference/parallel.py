"""Independent calls of one function, done here or handed to processes: who calls need not know."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Protocol, runtime_checkable


class ParallelMap(Protocol):
    """Calls a function of a module with each tuple of plain arguments and lists the results in that order."""

    def __call__(
        self,
        function: Callable[..., Any],
        arguments: Iterable[tuple[Any, ...]],
        done: Callable[[int], None] | None = None,
    ) -> list[Any]:
        """done: told the place of each call whose result is there, in order."""


@runtime_checkable
class Background(Protocol):
    """A :class:`ParallelMap` that can also begin a call and go on."""

    def begin(self, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
        """Begin a call; what is returned waits for its result."""
        ...


def begun(each: ParallelMap, function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """Begin a call of a module's function with plain arguments beside what this process does next; ask for its result.

    Where there is no other process it is made when its result is asked for, and never if that is not wanted.
    """
    if isinstance(each, Background):
        return each.begin(function, *arguments)
    return partial(function, *arguments)


def one_by_one(
    function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], done: Callable[[int], None] | None = None
) -> list[Any]:
    """All calls here, one after another."""
    results = []
    for place, parts in enumerate(arguments):
        results.append(function(*parts))
        if done is not None:
            done(place)
    return results
