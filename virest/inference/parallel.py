"""Independent calls of one function, done here or handed to processes: who calls need not know."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol


class ParallelMap(Protocol):
    """Calls a function of a module with each tuple of plain arguments and lists the results in that order."""

    def __call__(
        self,
        function: Callable[..., Any],
        arguments: Iterable[tuple[Any, ...]],
        done: Callable[[int], None] | None = None,
    ) -> list[Any]:
        """done: told the place of each call whose result is there, in order."""


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
