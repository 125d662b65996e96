"""The bench's tables for given figures. No figure here is measured with the machine's clock."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from virest.app.bench import __main__ as bench
from virest.app.bench import commands, compare, fields, growth, memory, peers, quality, speed, summary
from virest.app.bench.workload import (
    Run,
    Scale,
    Timing,
    looped_capture,
    recorded_frames,
    timed,
)
from virest.capture.folder import read_capture
from virest.capture.video import probe_movie
from virest.evaluation.baselines import PAPERS, SCIKIT

Facts = dict[str, Any]
STAGE_S = {"decode": 0.01, "estimate": 0.002, "deblur": 0.05, "shutter": 0.02, "write": 0.008}


def line(deblur: str = "hyper-laplacian", shutter: str = "rowwise", **stages: float) -> Facts:
    """One frame's line of a log."""
    return {"status": "restored", "seconds": {**STAGE_S, **stages}, "deblur": {"method": deblur},
            "shutter": {"method": shutter}, "blur": {"length_px": 9.0}}  # fmt: skip


def run(frames: int, wall_s: float, cpu_s: float, others_cores: float = 0.125, **of_line: Any) -> Run:
    """A run that was never started."""
    return Run(Path("nowhere"), [line(**of_line)] * frames, Timing(wall_s, cpu_s, others_cores))


def entry(name: str, wall_s: float, one_wall_s: float, **of_line: Any) -> Facts:
    """A measured preset: wall time per frame with two processes and with one, and CPU time 1.1 times as high."""

    def found(seconds: float, cores: int) -> Facts:
        runs = [run(n, 3 + n * seconds, 2 + 1.1 * cores * n * seconds, **of_line) for n in (20, 40)]
        return speed.per_frame(runs[0], runs[1], 20)

    return {"preset": name, **found(wall_s, 2), "one_process": found(one_wall_s, 1)}


def speed_facts(**of_floor: Any) -> Facts:
    """Everything the section ``speed`` returns, at known rates: floor 25, fast 10, balanced 8 and best 0.2 frames/s."""
    floor = entry("floor", 0.04, 0.076, **{"deblur": "none", **of_floor})
    measured = [floor, entry("fast", 0.1, 0.19), entry("balanced", 0.125, 0.2), entry("best", 5.0, 9.5)]
    return {"jobs": 2, "size": "720x1280", "content": "dead leaves", "blur_px": 9.0, "processor": "Z80",
            "transforms": "OpenCV", "planning_cpu_s": 3.0, **speed.judged(measured, 3.0),
            "peers_s_per_frame": {"wiener": 0.5}, "peers_missing": {"deepinv wiener": peers.GET_DEEPINV}}  # fmt: skip


def by_name(facts: Facts) -> dict[str, Facts]:
    """The presets' records by name."""
    return {e["preset"]: e for e in facts["presets"]}


# ── speed ────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_time_per_frame_is_the_difference_of_two_runs() -> None:
    """Start-up and planning time, which both runs share, cancels. Stages divide CPU time in proportion."""
    found = speed.per_frame(run(20, 7.0, 9.0), run(40, 10.0, 14.4), 20)
    assert found["frames"] == [20, 40]
    assert found["s_per_frame"] == pytest.approx(0.15)
    assert found["frames_per_s"] == pytest.approx(1 / 0.15)
    assert found["cpu_s_per_frame"] == pytest.approx(0.27)
    assert sum(found["stage_cpu_s"].values()) == pytest.approx(0.27)
    assert found["stage_cpu_s"]["deblur"] == pytest.approx(0.27 * 0.05 / 0.09)


def test_shares_scaling_and_estimation_follow_from_the_measured_times() -> None:
    """The ratio of floor to preset, of one process to two, and the planning time spread over a capture of 30 s."""
    fast = by_name(speed_facts())["fast"]
    assert fast["share_of_floor"] == pytest.approx(0.4)
    assert fast["share_of_floor_by_cpu"] == pytest.approx(0.4)
    assert fast["frames_per_s_by_cpu"] == pytest.approx(10 / 1.1)
    assert fast["share_of_floor_by_stages"] == pytest.approx(0.038 / 0.09)
    assert fast["scaling"] == pytest.approx(1.9)
    assert fast["scaling_by_cpu"] == pytest.approx(1.9)
    assert fast["estimate_share"] == pytest.approx(0.002 / 0.09)
    assert fast["estimate_share_with_planning"] == pytest.approx((3 + 99 * 0.002 / 0.09) / 102)


@pytest.mark.parametrize("spoilt", [{"shutter": "none"}, {"deblur": "wiener"}])
def test_a_floor_with_other_work_than_decode_warp_and_png_is_not_used(spoilt: Facts) -> None:
    """A floor run without warping, or with deblurring, measures something else: no share is reported."""
    facts = speed_facts(**spoilt)
    assert not facts["floor"]["pure"]
    assert all(e["share_of_floor"] is None for e in facts["presets"])
    assert "NOT MEASURED" in speed.speed_text(facts)
    assert "NOT MEASURED" not in speed.speed_text(speed_facts())


def test_the_speed_tables_list_every_preset_stage_and_peer() -> None:
    """Floor and presets appear with their rates, peers with their ratios, a missing peer with its install command."""
    text = speed.speed_text(speed_facts())
    rows = {words[0]: words for words in (line.split() for line in text.splitlines()) if words}
    assert [rows[name][1] for name in ("floor", "fast", "balanced", "best")] == ["25.00", "10.00", "8.00", "0.20"]
    assert all(stage in text for stage in speed.STAGES)
    deblur_s = 1.1 * 0.19 * 0.05 / 0.09
    assert rows["wiener"][2] == f"{0.5 / deblur_s:.1f}"
    assert "pip install 'virest[peers]'" in text


def test_a_stage_without_work_has_no_rate() -> None:
    """A stage that takes no time has neither a rate nor a ratio to a peer."""
    assert speed.stage_rate(0.0) == "-"
    assert speed.stage_rate(0.004) == "250"
    idle = entry("fast", 0.1, 0.2, deblur="none")
    idle["one_process"]["stage_cpu_s"]["deblur"] = 0.0
    assert speed.ratio_to_peer(0.5, idle) is None


def test_deepinv_wiener_is_the_wiener_filter() -> None:
    """An asymmetric kernel gives conj(K) / (|K|² + N/S) in deepinv's convention as in ours."""
    pytest.importorskip("deepinv")
    rng = np.random.default_rng(3)
    plane, kernel = rng.random((60, 44), np.float32), rng.random((7, 7), np.float32)
    kernel[2:, 4:] = 0
    kernel /= kernel.sum()
    ours = PAPERS["wiener-flat"].deconvolve(plane, kernel, 0.03)
    np.testing.assert_allclose(peers.deepinv_wiener(plane, kernel, 0.03), ours, atol=1e-4)


def test_every_scikit_method_has_settings_for_timing() -> None:
    """The timed peers are exactly the methods that the library offers."""
    assert set(speed.PEER_SETTINGS) == set(SCIKIT)


def test_a_negative_wall_time_difference_gives_no_rate() -> None:
    """Other processes can make the longer run seem shorter; the shares by CPU time are still reported."""
    found = speed.per_frame(run(20, 7.0, 9.0), run(40, 6.5, 14.4), 20)
    assert found["frames_per_s"] is None
    whole = {"preset": "fast", **found, "one_process": found}
    facts = speed_facts()
    (fast,) = speed.judged([facts["floor"], whole], 3.0)["presets"]
    assert fast["scaling"] is None
    assert fast["share_of_floor"] is None
    assert fast["share_of_floor_by_cpu"] == pytest.approx(0.088 / 0.27)
    row = next(line for line in speed.speed_text({**facts, "presets": [fast]}).splitlines() if line.startswith("fast"))
    assert row.split()[1] == "-"


# ── growth ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_known_exponent_is_recovered() -> None:
    """The fit is exact without noise; with noise, its standard deviation matches the scatter of the errors."""
    sizes = np.array([3.0, 7.0, 20.0, 90.0])
    assert growth.fitted_exponent(sizes, 0.2 * sizes**1.3) == (pytest.approx(1.3), pytest.approx(0.0, abs=1e-9))
    assert growth.fitted_exponent(sizes[:2], 5 * sizes[:2] ** -0.4) == (pytest.approx(-0.4), None)
    rng = np.random.default_rng(11)
    fits = [growth.fitted_exponent(sizes, sizes**0.8 * np.exp(0.1 * rng.standard_normal(4))) for _ in range(400)]
    errors = np.array([(found - 0.8) for found, _ in fits])
    assert errors.std() == pytest.approx(np.sqrt(np.mean([std**2 for _, std in fits if std])), rel=0.15)
    assert abs(errors.mean()) < 0.01


@pytest.mark.parametrize("power", [0.9, 1.0, 1.4])
def test_start_up_time_does_not_bias_the_growth_exponent(power: float) -> None:
    """Times of start + c frames^p at N, 2 N and 4 N frames give p, whatever the start takes."""
    rows = [{"frames": n, "wall_s": 7 + 0.05 * n**power, "cpu_s": 2 + 0.08 * n**power} for n in (30, 60, 120)]
    found = growth.doubling_exponents(rows)
    assert found == {"exponent": pytest.approx(power), "wall_exponent": pytest.approx(power)}


def test_decreasing_times_give_no_exponent() -> None:
    """On a busy machine, more frames may seem to take less time."""
    rows = [{"frames": n, "wall_s": w, "cpu_s": n / 10} for n, w in ((30, 9.0), (60, 8.0), (120, 12.0))]
    assert growth.doubling_exponents(rows)["wall_exponent"] is None
    spoilt = [{"pixels": 100, "cpu_s_per_frame": -0.1}, {"pixels": 300, "cpu_s_per_frame": 0.2}]
    assert growth._fitted(spoilt, "pixels", "cpu_s_per_frame") == {"exponent": None, "std": None}
    assert growth.exponent_text({"exponent": None}) == "not determined by these runs"


def growth_facts() -> Facts:
    """Everything the section ``growth`` returns for a time that is linear in frames."""
    rows = [{"frames": n, "wall_s": 5 + 0.05 * n, "cpu_s": 3 + 0.1 * n} for n in (30, 60, 120)]
    times = {"s_per_frame": 0.1, "cpu_s_per_frame": 0.09, "deblur_cpu_s": 0.04, "others_cores": 0.0}
    return {
        "preset": "fast",
        "frames": {"rows": growth.with_steps(rows), **growth.doubling_exponents(rows)},
        "pixels": {"rows": [{"size": "360x640", "pixels": 230400, **times}], "exponent": 1.07, "std": 0.02},
        "tiles": {"rows": [{"tile_px": 144, "tiles": 44.4, **times}], "exponent": 0.31, "std": 0.05},
    }


def test_the_growth_tables_show_the_time_of_one_more_frame() -> None:
    """The first run has no earlier run to compare with; the others give the same time per additional frame."""
    text = growth.growth_text(growth_facts())
    rows = [line.split() for line in text.splitlines()]
    assert ["30", "6.5", "6.0", "-", "-"] in rows
    assert ["120", "11.0", "15.0", "50", "100"] in rows
    assert "p = 1.07 ± 0.02" in text
    assert ["144", "44", "90", "40"] in rows


# ── memory and commands ──────────────────────────────────────────────────────────────────────────────────────────


CHILD = "import time; kept = bytearray(120_000_000); del kept; time.sleep(1.5)"
PARENT = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {CHILD!r}], check=True)"


def test_a_workers_peak_is_separate_and_recorded_after_it_exits() -> None:
    """The kernel's record separates the peak of a child, which frees its memory, from that of its parent."""
    peaks = memory.peaks_of([sys.executable, "-c", PARENT])
    assert peaks.worker_bytes > 120e6
    assert 1e6 < peaks.main_bytes < 60e6
    with pytest.raises(subprocess.CalledProcessError):
        memory.peaks_of([sys.executable, "-c", "raise SystemExit(3)"])


def test_memory_is_reported_for_a_worker_and_in_total() -> None:
    """The report also states how much the longest movie takes relative to the shortest."""
    facts = memory_facts()
    assert facts["grown"] == {"peak": pytest.approx(1.1), "worker": pytest.approx(1.04)}
    rows = [line.split() for line in memory.memory_text(facts).splitlines()]
    assert ["3000", "260", "200", "770", "90.0"] in rows


def memory_facts() -> Facts:
    """Everything the section ``memory`` returns for a worker that grows little and a total that grows more."""
    runs = [
        {"frames": 100, "worker_mb": 250.0, "main_mb": 190.0, "peak_mb": 700.0, "wall_s": 12.0},
        {"frames": 3000, "worker_mb": 260.0, "main_mb": 200.0, "peak_mb": 770.0, "wall_s": 90.0},
    ]
    return {"preset": "fast", "runs": runs, "grown": memory.grown(runs)}


BUSY = "import time\nwhile time.process_time() < 0.2: pass"


def test_the_time_of_a_command_includes_its_children() -> None:
    """The CPU time of a grandchild counts; a failing command gives no measurement."""
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {BUSY!r}], check=True)"
    timing = timed([sys.executable, "-c", parent])
    assert timing.cpu_s >= 0.2
    assert timing.others_cores >= 0.0
    with pytest.raises(subprocess.CalledProcessError):
        timed([sys.executable, "-c", "raise SystemExit(3)"])


def test_the_fastest_of_several_runs_of_a_command_counts() -> None:
    """Its time is compared with the target; a failed command is reported with its exit code."""
    tries = [Timing(4.0, 3.0, 1.0), Timing(2.0, 1.5, 0.1), Timing(2.5, 1.0, 0.0)]
    row = commands.record("inspect", "inspect, 600 s", tries, 5.0)
    assert (row["wall_s"], row["cpu_s"], row["part_of_asked"], row["cpu_part_of_asked"]) == (2.0, 1.5, 0.4, 0.3)
    failed = {"command": "calibrate", "title": "calibrate, 32 s", "asked_s": 32.0, "exit_code": 4}
    text = commands.commands_text([row, failed])
    assert "exit code 4" in text
    assert ["inspect,", "600", "s", "5", "2.00", "1.50", "0.40", "0.1"] in [line.split() for line in text.splitlines()]


# ── a looped capture ─────────────────────────────────────────────────────────────────────────────────────────────


def test_a_looped_capture_repeats_its_frames_exactly(tmp_path: Path) -> None:
    """Packets are copied: every group of 30 starts with a key frame and decodes to the same frames."""
    folder = looped_capture(tmp_path, 75, 160, 120)
    index = probe_movie(folder / "movie.mp4")
    assert len(index) == 75
    assert tuple(index.keyframes) == (0, 30, 60)
    shown = [picture for _, picture in recorded_frames(folder)]
    for k in range(30, 75):
        np.testing.assert_array_equal(shown[k], shown[k - 30])
    assert np.abs(shown[0].astype(int) - shown[1]).max() > 50
    capture = read_capture(folder)
    np.testing.assert_allclose(np.diff([frame.time_s for frame in capture.frames]), 1 / 30, atol=2e-6)
    assert capture.imu.time_s[-1] > capture.frames[-1].time_s + 0.4


# ── summary ──────────────────────────────────────────────────────────────────────────────────────────────────────


def command_facts(seconds: float) -> Facts:
    """What the section ``commands`` returns for one command."""
    return {"commands": [commands.record("help", "virest --help", [Timing(seconds, 0.2, 0.0)], 0.3)]}


def report(**sections: Facts) -> Facts:
    """A report of the bench with these sections."""
    versions = {"virest": "1", "commit": "abc", "cores": 2, "load": 0.5, "numpy": "2.0"}
    return {"virest_bench": 1, "versions": versions, "scale": "quick", **sections}


def met(given: Facts) -> dict[str, str]:
    """Last column of the summary by figure."""
    return {row.figure: row.met for row in summary.summary_rows(given)}


def test_the_summary_compares_each_figure_with_its_target() -> None:
    """Some targets are met, some are missed, and figures without a target show a dash."""
    found = met(report(speed=speed_facts(), growth=growth_facts(), memory=memory_facts(), commands=command_facts(0.31)))
    assert found["fast: of the floor"] == "NO"
    assert found["balanced: of the floor"] == "-"
    assert found["balanced: frames/s, 2 processes"] == "yes"
    assert found["best: frames/s, 2 processes"] == "NO"
    assert found["fast: 1 -> 2 processes"] == "yes"
    assert found["balanced: 1 -> 2 processes"] == "NO"
    assert found["fast: estimation"] == "NO"
    assert found["best: estimation"] == "yes"
    assert found["time over frames, exponent"] == "yes"
    assert found["memory of the largest worker"] == "yes"
    assert found["memory, 3000 over 100 frames"] == "NO"
    assert found["virest --help"] == "NO"
    assert met(report(commands=command_facts(0.29)))["virest --help"] == "yes"


@pytest.mark.parametrize(
    ("by_wall", "by_cpu", "others_cores", "ratio", "said"),
    [
        (True, False, 0.1, False, "yes"),
        (False, True, 0.1, True, "NO"),
        (True, True, 1.2, False, "yes"),
        (False, True, 1.2, False, "busy"),
        (True, True, 1.2, True, "busy"),
        (False, False, 1.2, True, "NO"),
    ],
)
def test_on_a_busy_machine_only_conclusive_figures_are_judged(
    by_wall: bool, by_cpu: bool, others_cores: float, ratio: bool, said: str
) -> None:
    """A target met despite other load is met, a target missed by CPU time is missed, and the rest stays open."""
    assert summary.judge(by_wall, by_cpu, others_cores, ratio=ratio) == said


def test_the_summary_lists_only_sections_that_ran() -> None:
    """A section that did not run has no row; without any section that has targets, there is no summary."""
    text = summary.summary_text(report(memory=memory_facts()))
    assert "260 MB" in text
    assert "frames/s" not in text
    assert summary.summary_text(report(shutter={"captures": []})) == ""


def test_the_summary_names_missing_peers() -> None:
    """A missing peer is listed with its install command."""
    text = summary.summary_text(report(speed=speed_facts()))
    assert "scikit-image wiener / deblur stage" in text
    assert "pip install 'virest[peers]'" in text


# ── comparing ────────────────────────────────────────────────────────────────────────────────────────────────────


def changes(old: Facts, new: Facts, noise: float = compare.NOISE) -> dict[str, compare.Change]:
    """Compared figures of two reports' sections by name."""
    return {change.name: change for change in compare.compared(report(**old), report(**new), noise)}


def test_figures_are_matched_by_name_and_not_by_position() -> None:
    """Lists of records may grow or be reordered."""
    old = {"speed": {"presets": [{"preset": "fast", "s_per_frame": 0.2}, {"preset": "best", "s_per_frame": 4.0}]}}
    new = {"speed": {"presets": [{"preset": "best", "s_per_frame": 2.0}, {"preset": "new", "s_per_frame": 9.0},
                                 {"preset": "fast", "s_per_frame": 0.3}]}}  # fmt: skip
    found = changes(old, new)
    assert set(found) == {"speed.presets[fast].s_per_frame", "speed.presets[best].s_per_frame"}
    fast, best = found["speed.presets[fast].s_per_frame"], found["speed.presets[best].s_per_frame"]
    assert (fast.ratio, fast.mark) == (pytest.approx(1.5), "worse")
    assert (best.ratio, best.mark) == (pytest.approx(0.5), "better")


@pytest.mark.parametrize(
    ("name", "old", "new", "mark"),
    [
        ("frames_per_s", 10.0, 11.0, ""),
        ("frames_per_s", 10.0, 12.0, "better"),
        ("frames_per_s", 10.0, 8.0, "worse"),
        ("wall_s", 10.0, 12.0, "worse"),
        ("worker_mb", 300.0, 310.0, ""),
        ("worker_mb", 300.0, 330.0, "worse"),
        ("min_gain_db", 0.01, 0.04, ""),
        ("min_gain_db", -0.02, 0.04, "better"),
        ("mean_gain_db", 30.0, 29.9, "worse"),
        ("tiles", 40.0, 60.0, "changed"),
        ("growth", 0.0, 1.0, "changed"),
    ],
)
def test_a_change_beyond_the_noise_is_marked_by_its_direction(name: str, old: float, new: float, mark: str) -> None:
    """Times are compared by ratio, memory with a tighter limit, decibels by difference.

    A figure without a better direction is marked as changed.
    """
    (change,) = changes({"some": {name: old}}, {"some": {name: new}}).values()
    assert change.mark == mark
    assert change.ratio == (None if old == 0 else pytest.approx(new / old))


def test_the_noise_level_can_be_set() -> None:
    """A change within the given noise is not marked."""
    old, new = {"some": {"wall_s": 10.0}}, {"some": {"wall_s": 13.0}}
    assert changes(old, new, 0.5)["some.wall_s"].mark == ""
    assert changes(old, new, 0.1)["some.wall_s"].mark == "worse"


def test_differences_of_machine_version_and_scale_are_reported() -> None:
    """So are sections that only one report has and other load during the run; equal entries are not repeated."""
    old, new = report(memory=memory_facts()), report(commands=command_facts(0.2))
    new["versions"] = {**new["versions"], "numpy": "2.1", "load": 3.0}
    new["scale"] = "usual"
    text = compare.compare_text(old, new)
    assert "numpy: 2.0 -> 2.1" in text
    assert "load: 0.5 -> 3.0" in text
    assert "the scales differ" in text
    assert "commit" not in text
    assert "only in the old report: memory" in text
    assert "only in the new report: commands" in text
    assert "no figure in common" in text
    assert "cores busy" not in text
    new["commands"]["commands"][0]["others_cores"] = 1.25
    assert "new commands: other processes kept 1.2 cores busy" in compare.compare_text(old, new)


def test_a_report_compared_with_itself_shows_no_change() -> None:
    """Every figure of every section has ratio 1 and no mark; words, targets and verdicts are not compared."""
    whole = report(speed=speed_facts(), growth=growth_facts(), memory=memory_facts(), commands=command_facts(0.2))
    found = compare.compared(whole, json.loads(json.dumps(whole)))
    names = {change.name for change in found}
    assert len(found) == len(names) > 60
    assert {change.ratio for change in found} <= {1.0, None}
    assert not any(change.mark for change in found)
    assert "speed.presets[best].one_process.stage_cpu_s.deblur" in names
    assert "memory.runs[3000].worker_mb" in names
    assert not any("load" in name or "asked_s" in name or "pure" in name for name in names)


# ── the program ──────────────────────────────────────────────────────────────────────────────────────────────────


def test_two_reports_are_compared_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is measured and nothing is written."""
    paths = [tmp_path / name for name in ("old.json", "new.json")]
    for path, seconds in zip(paths, (0.2, 0.4), strict=True):
        path.write_text(json.dumps(report(commands=command_facts(seconds))))
    bench.main(["--compare", *map(str, paths), "--out", str(tmp_path / "none")])
    assert ["commands.commands[help].wall_s", "0.2", "0.4", "2.000", "worse"] in [
        line.split() for line in capsys.readouterr().out.splitlines()
    ]
    assert not (tmp_path / "none").exists()


def test_a_file_that_is_not_a_report_is_rejected(tmp_path: Path) -> None:
    """Any other JSON raises an error."""
    (tmp_path / "run.json").write_text('{"virest_run": 1}')
    with pytest.raises(ValueError, match="not a report"):
        compare.read_report(tmp_path / "run.json")


def test_a_section_is_printed_saved_and_summarised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The summary is printed last; bench.json holds the figures, the versions and the commit."""

    def fake(_work: Path, scale: Scale) -> tuple[Facts, str]:
        return command_facts(0.2), f"TOLD {scale.name}"

    monkeypatch.setitem(bench.SECTIONS, "commands", fake)
    bench.main(["--only", "commands", "--quick", "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert printed.index("TOLD quick") < printed.index("SUMMARY") < printed.index("virest --help")
    kept = json.loads((tmp_path / "bench.json").read_text())
    assert kept["commands"] == command_facts(0.2)
    assert {"virest", "commit", "python", "numpy", "deepinv", "processor", "load"} <= kept["versions"].keys()
    assert [path.name for path in tmp_path.iterdir()] == ["bench.json"]


def test_the_quality_table_averages_only_kinds_with_several_captures() -> None:
    """A kind with one capture has one row; the worst frames have a table of their own."""
    gains = {method: 1.0 if method in quality.PRESETS else -1.0 for method in quality.METHODS}
    frames = [("leaves", "ordinary"), ("phone-calm", "phone"), ("phone-fast", "phone")]
    rows = [{"capture": name, "kind": kind, "frame": 0, "in_range": True, "straightened_db": 20.0,
             "gain_db": {**gains, "fast": 0.25 + number}} for number, (name, kind) in enumerate(frames)]  # fmt: skip
    means, worst = quality._text(quality.summarise(rows)).split("the same for the worst frame")
    assert "ALL ordinary" not in means
    assert means.splitlines()[-2].split()[-7:-5] == ["20.00", "+1.75"]
    assert worst.splitlines()[-1].split()[-3:] == ["+1.25", "+1.00", "+1.00"]


def test_the_summary_of_unknown_effects_can_be_saved() -> None:
    """Counts of numpy's truth values are numbers that JSON holds; captures without an effect count as nulls."""
    effect = {"hidden": "uneven", "right": np.True_, "fields": ["a field"], "gone_elsewhere": np.float64(0.9)}
    rows = [{**effect, "pictures_db": [np.float64(0.5), np.float64(-0.2)]}]
    rows.append({**effect, "hidden": fields.NULL, "fields": [], "gone_elsewhere": None, "pictures_db": []})
    found = json.loads(json.dumps(fields.summarise(rows)))
    assert found == {
        "captures": 1, "right": 1, "solved_elsewhere": 1, "of_elsewhere": 1, "pictures_better": 1, "pictures_worse": 1,
        "of_pictures": 1, "false_alarms": 0, "nulls": 1,
    }  # fmt: skip
