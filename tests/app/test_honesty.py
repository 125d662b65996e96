"""The honesty bench's tables for given predictions and gains."""

from pathlib import Path
from typing import Any

import pytest

from virest.app.bench import compare, honesty, summary
from virest.app.bench.workload import Scale, honesty_workloads, quality_workloads, simulated

Facts = dict[str, Any]


def promised(of: str, capture: str, preset: str, frame: int, promise: float | None, gain: float) -> Facts:
    """One frame's record."""
    return {"set": of, "capture": capture, "preset": preset, "frame": frame, "blur_px": 7.0, "straightened_db": 25.0,
            "deblurred": promise is not None, "promise_db": promise, "promise_std_db": None,
            "gain_db": gain}  # fmt: skip


HONEST_ROWS = [
    promised("nominal", "leaves", "fast", 0, 2.0, 2.5),
    promised("phone", "calm", "fast", 0, 1.0, -0.5),
    promised("phone", "calm", "fast", 1, 0.5, 0.6),
    promised("phone", "calm", "fast", 2, None, 0.0),
    promised("phone", "dim", "fast", 0, 3.0, -1.5),
]


def test_honesty_counts_losses_and_their_predicted_gains() -> None:
    """Two of the phones' four frames lose 1 dB on average; the median error of three predictions is 1.5 dB."""
    found = {(e["set"], e["capture"]): e for e in honesty.summarise_honesty(HONEST_ROWS)}
    phones = found["phone", None]
    assert (phones["of"], phones["deblurred"], phones["promised"], phones["promised_and_worse"]) == (4, 3, 3, 2)
    assert phones["mean_gain_db"] == pytest.approx(-0.35)
    assert phones["worse_share"] == pytest.approx(0.5)
    assert phones["worse_mean_db"] == pytest.approx(-1.0)
    assert phones["worst_db"] == pytest.approx(-1.5)
    assert phones["promise_off"] == pytest.approx(1.5)
    assert found["nominal", None]["worse_mean_db"] is None
    assert found["phone", "dim"]["of"] == 1


def test_the_honesty_tables_mark_every_frame_that_got_worse() -> None:
    """Each frame has a line with predicted and measured gain.

    The summary judges each set, and the mean gain only for phones.
    """
    lines = honesty.frames_text(HONEST_ROWS[1:4], ["fast"]).splitlines()[1:]
    assert [line.endswith("!") for line in lines] == [True, False, False]
    assert "+1.00 / -0.50" in lines[0]
    assert "- / +0.00" in lines[2]
    rows = {
        row.figure: row
        for row in summary.summary_rows({"honesty": {"summary": honesty.summarise_honesty(HONEST_ROWS)}})
    }
    assert rows["phone, fast: mean gain"].met == summary.NO
    assert rows["nominal, fast: mean gain"].met == summary.OPEN
    assert rows["phone, fast: frames made worse"].met == summary.NO
    assert rows["nominal, fast: frames made worse"].met == summary.YES
    assert "ALL PHONE" in honesty.honesty_text(honesty.summarise_honesty(HONEST_ROWS))


def test_the_comparison_knows_the_better_direction_of_honesty_figures() -> None:
    """Smaller prediction errors, smaller shares of worse frames and a higher worst gain are better."""
    assert compare.better_direction("honesty.summary[phone fast].promise_off") == -1
    assert compare.better_direction("honesty.summary[phone fast].worse_share") == -1
    assert compare.better_direction("honesty.summary[phone fast].worst_db") == 1


def test_phones_are_measured_in_both_sections_with_the_nominal_profile() -> None:
    """Only the defocused captures get a profile of their own: deblurring must do no harm even with the true profile."""
    phones = {"phone-calm", "phone-fast", "phone-stabilised", "phone-dim"}
    for scale in (Scale(), Scale(quick=True)):
        assert phones <= {w.name for w in quality_workloads(scale)}
    assert phones <= {w.name for w in honesty_workloads(Scale())}
    for workload in honesty_workloads(Scale()):
        told = workload.arguments(Path("capture"))
        assert bool(told) == (workload.kind == "defocused")
        assert ("isp" in workload.options) == (workload.kind == "phone")
    assert len(honesty_workloads(Scale(quick=True))) == 4


def test_the_quality_table_of_one_kind_measures_only_that_kind() -> None:
    """The six shaken scenes are not in the quick set; selecting their kind measures four frames of each."""
    assert not [w for w in quality_workloads(Scale(quick=True)) if w.kind == "shaken"]
    for scale, frames in ((Scale(kinds=("shaken",)), 8), (Scale(quick=True, kinds=("shaken",)), 4)):
        chosen = quality_workloads(scale)
        assert [w.kind for w in chosen] == ["shaken"] * 6
        assert {w.options["frames"] for w in chosen} == {frames}
    assert len(quality_workloads(Scale())) == len({w.name for w in quality_workloads(Scale())})


def test_a_cached_capture_is_reused_only_with_the_same_options(tmp_path: Path) -> None:
    """With other options it is simulated again under the same name."""
    options = {"width": 64, "height": 48, "frames": 2, "exposure_ms": 4.0}
    movie = simulated(tmp_path, "small", **options) / "movie.mp4"
    first = movie.stat().st_mtime_ns
    assert simulated(tmp_path, "small", **options) == movie.parent
    assert movie.stat().st_mtime_ns == first
    simulated(tmp_path, "small", **options, seed=4)
    assert movie.stat().st_mtime_ns != first
