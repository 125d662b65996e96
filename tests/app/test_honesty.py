"""The honesty bench: what its tables say of given promises and gains."""

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


def test_honesty_counts_losses_and_the_promises_made_for_them() -> None:
    """Of the phones' four frames two are worse, by 1 dB in the mean; the median miss of three promises is 1.5 dB."""
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


def test_the_honesty_tables_mark_every_frame_that_was_made_worse() -> None:
    """A line a frame, promise beside gain; the summary judges each set, the gain of the phones alone."""
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


def test_fewer_promises_missed_and_fewer_frames_made_worse_is_better() -> None:
    """The comparison of two reports knows the directions; a set's record is found again by its name."""
    assert compare.better_direction("honesty.summary[phone fast].promise_off") == -1
    assert compare.better_direction("honesty.summary[phone fast].worse_share") == -1
    assert compare.better_direction("honesty.summary[phone fast].worst_db") == 1


def test_phones_are_measured_in_both_sections_and_their_profile_is_the_nominal_one() -> None:
    """The defocused captures alone get the true profile: nothing is wrong with it, and still it must do no harm."""
    phones = {"phone-calm", "phone-fast", "phone-stabilised", "phone-dim"}
    for scale in (Scale(), Scale(quick=True)):
        assert phones <= {w.name for w in quality_workloads(scale)}
    assert phones <= {w.name for w in honesty_workloads(Scale())}
    for workload in honesty_workloads(Scale()):
        told = workload.arguments(Path("capture"))
        assert bool(told) == (workload.kind == "defocused")
        assert ("isp" in workload.options) == (workload.kind == "phone")
    assert len(honesty_workloads(Scale(quick=True))) == 4


def test_the_quality_table_of_one_kind_measures_that_kind_alone() -> None:
    """The six shaken scenes are not among the quick ones, but a look at their kind measures four frames of each."""
    assert not [w for w in quality_workloads(Scale(quick=True)) if w.kind == "shaken"]
    for scale, frames in ((Scale(kinds=("shaken",)), 8), (Scale(quick=True, kinds=("shaken",)), 4)):
        chosen = quality_workloads(scale)
        assert [w.kind for w in chosen] == ["shaken"] * 6
        assert {w.options["frames"] for w in chosen} == {frames}
    assert len(quality_workloads(Scale())) == len({w.name for w in quality_workloads(Scale())})


def test_a_kept_capture_is_used_again_only_if_it_is_the_same(tmp_path: Path) -> None:
    """The same options: not touched; others: made anew under its name."""
    options = {"width": 64, "height": 48, "frames": 2, "exposure_ms": 4.0}
    movie = simulated(tmp_path, "small", **options) / "movie.mp4"
    first = movie.stat().st_mtime_ns
    assert simulated(tmp_path, "small", **options) == movie.parent
    assert movie.stat().st_mtime_ns == first
    simulated(tmp_path, "small", **options, seed=4)
    assert movie.stat().st_mtime_ns != first
