"""Plain text tables."""

from __future__ import annotations


def table(header: list[str], rows: list[list[str]]) -> str:
    """Format columns under their headings, the first left-aligned, the others right-aligned."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]

    def line(row: list[str]) -> str:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        cells[0] = row[0].ljust(widths[0])
        return "  ".join(cells).rstrip()

    return "\n".join(line(row) for row in [header, *rows])


def decibels(value: float | None) -> str:
    """A gain as text, with its sign; ``-`` for None."""
    return "-" if value is None else f"{value:+.2f}"
