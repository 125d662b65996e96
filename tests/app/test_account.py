"""What run.json adds up over the lines of a run."""

import json
from pathlib import Path

import pytest

from virest.app.account import run_totals


def line(status: str, **deblur: object) -> dict[str, object]:
    """A line of the log, as far as it is added up."""
    return {"status": status, "done": ["deblurred"] if deblur else [], "seconds": {"write": 0.5}, "deblur": deblur}


def test_what_neighbours_brought_is_the_mean_over_frames_that_had_some(tmp_path: Path):
    """Frames without neighbours count for nothing; a run without any says null."""
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
