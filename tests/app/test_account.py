"""Totals that run.json computes from the lines of a run's log."""

import json
from pathlib import Path

import pytest

from virest.app.account import run_totals


def line(status: str, **deblur: object) -> dict[str, object]:
    """The fields of a log line that enter the totals."""
    return {"status": status, "done": ["deblurred"] if deblur else [], "seconds": {"write": 0.5}, "deblur": deblur}


def test_the_neighbours_gain_is_the_mean_over_frames_that_used_neighbours(tmp_path: Path):
    """Frames without neighbours do not enter the mean; a run without any neighbours reports null."""
    log = tmp_path / "parameters.jsonl"
    two = [{"frame": 1, "weight": 0.9}, {"frame": 3, "weight": 0.7}]
    lines = [
        line("restored", neighbours=two, neighbours_gain_db=2.0),
        line("restored", neighbours=two[:1], neighbours_gain_db=1.0),
        line("restored", neighbours=[], neighbours_gain_db=0.0),
        line("copied"),
    ]
    log.write_text("".join(json.dumps(one) + "\n" for one in lines))
    totals = run_totals([log])
    assert totals["neighbours"] == {"frames": 2, "mean_taken": 1.5, "mean_gain_db": 1.5}
    assert (totals["counts"]["restored"], totals["counts"]["copied"], totals["counts"]["deblurred"]) == (3, 1, 3)
    assert totals["seconds"]["write"] == pytest.approx(2.0)
    log.write_text(json.dumps(lines[-1]) + "\n")
    assert run_totals([log])["neighbours"] == {"frames": 0, "mean_taken": None, "mean_gain_db": None}
