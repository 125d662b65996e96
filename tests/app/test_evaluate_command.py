"""``virest evaluate shutter`` and ``deblur``: consistent tables, virest ahead of the baselines, and usage errors."""

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from virest.app.evaluate_deblur import DeblurOptions, run_deblur
from virest.app.evaluate_shutter import METHODS, ShutterOptions, run_shutter
from virest.app.simulate import simulate_command
from virest.errors import CaptureError
from virest.evaluation.fidelity import psnr_of

Virest = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fast pan over a marked chessboard larger than the frame, as ``simulate --scene board`` makes it."""
    folder = tmp_path_factory.mktemp("captures") / "wall"
    wishes: dict[str, Any] = {"rate_rad_s": 2.0, "exposure_ms": 1.0, "bitrate_bits_per_px": 2.0, "seed": 77}
    simulate_command(folder, scene="board", width=400, height=304, frames=5, focal_px=380.0, **wishes)
    return folder


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two blurred frames of leaves."""
    folder = tmp_path_factory.mktemp("captures") / "shaken"
    wishes: dict[str, Any] = {"rate_rad_s": 2.2, "exposure_ms": 16.0, "bitrate_bits_per_px": 1.0, "seed": 79}
    simulate_command(folder, scene="leaves", width=320, height=240, frames=2, **wishes)
    return folder


@pytest.fixture(scope="module")
def judged_shutter(board: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], str, Path]:
    """The board's evaluation, shared by all tests."""
    maps = tmp_path_factory.mktemp("maps")
    facts, text = run_shutter(ShutterOptions((str(board),), out=maps))
    return facts, text, maps


def test_row_by_row_straightening_is_ahead_in_angles_and_pictures(judged_shutter) -> None:
    """It leaves less than a fifth of any other method's angle error at the outer corners, and leads in MSE and SSIM."""
    methods = judged_shutter[0]["all"]["methods"]
    ours = methods["rowwise"]
    assert ours["outer"]["mean_abs_deg"] < 0.05
    for name in ("none", "schubert2018", "perspective"):
        other = methods[name]
        assert ours["outer"]["mean_abs_deg"] < 0.2 * other["outer"]["mean_abs_deg"], name
        assert ours["neighbours"]["mean_abs_deg"] < other["neighbours"]["mean_abs_deg"], name
        assert (ours["mse"] < other["mse"], ours["ssim"] > other["ssim"]) == (True, True), name


def test_every_figure_comes_with_its_count_and_mse_agrees_with_psnr(judged_shutter) -> None:
    """All methods are averaged over the same angles; each PSNR follows from the MSE beside it."""
    facts, text, maps = judged_shutter
    whole = facts["all"]
    assert set(whole["methods"]) == set(METHODS)
    for found in whole["methods"].values():
        assert found["psnr_db"] == pytest.approx(psnr_of(found["mse"]), abs=1e-9)
        assert found["outer"]["count"] == 4 * whole["frames"]
        assert found["neighbours"]["count"] == whole["detector_on_truth"]["neighbours"]["count"]
        assert found["outer"]["max_abs_deg"] >= found["outer"]["mean_abs_deg"]
    example = facts["example"]
    assert example["static_deg"] == pytest.approx(90, abs=15)
    assert "OpenCV" in text
    assert "rowwise" in text
    sheet = cv2.imread(str(maps / "wall-difference.png"))
    assert sheet is not None
    width = sheet.shape[1] // (len(METHODS) + 1)
    assert sheet[30:, width : 2 * width].mean() > 3 * sheet[30:, -width:].mean()


def test_joint_restoration_is_ahead_of_single_frames_and_merging(tmp_path: Path) -> None:
    """Neighbouring frames of the movie are used even if only one frame is evaluated."""
    folder = tmp_path / "over_time"
    wishes: dict[str, Any] = {"rate_rad_s": 1.8, "exposure_ms": 16.0, "bitrate_bits_per_px": 1.0, "seed": 80}
    simulate_command(folder, scene="leaves", width=320, height=240, frames=7, **wishes)
    facts, text = run_deblur(DeblurOptions((str(folder),), frames=slice(4, 5), over_time=True))
    psnr = {name: summary["psnr_db"] for name, summary in facts["methods"].items()}
    assert facts["frames"] == 1
    assert set(psnr) == {
        "blurred", "align and average", "Fourier burst", "virest best, single", "virest balanced", "virest best",
    }  # fmt: skip
    assert psnr["blurred"] < psnr["virest best, single"] < psnr["virest balanced"] < psnr["virest best"]
    assert psnr["virest best"] > psnr["Fourier burst"] > psnr["align and average"]
    assert "over time" in text


def test_deblurring_is_ahead_of_the_baselines_in_all_measures(shaken: Path, tmp_path: Path) -> None:
    """It leads in PSNR, SSIM and matches where the blur varies over the frame; each PSNR follows from its MSE."""
    facts, text = run_deblur(DeblurOptions((str(shaken),), frames=slice(0, 1), out=tmp_path))
    assert facts["first"]["virest best"] == {"part": 1.0, "led_by": {}}
    for found in facts["methods"].values():
        assert found["psnr_db"] == pytest.approx(psnr_of(found["mse"]), abs=1e-9)
    assert {"blurred", "inverse", "wiener-flat", "luan2022", "dong2020"} <= set(facts["methods"])
    assert "SIFT" in text
    assert (tmp_path / "shaken-000000-difference.png").is_file()


def test_a_missing_scikit_image_is_left_out_with_a_note(
    shaken: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its rows are missing, and the text states why."""
    import virest.evaluation.baselines as baselines

    monkeypatch.setattr(baselines, "find_spec", lambda name: None)
    kept = {name: b for name, b in baselines.BASELINES.items() if b.library or name == "inverse"}
    monkeypatch.setattr("virest.app.evaluate_deblur.BASELINES", kept)
    monkeypatch.setattr("virest.app.evaluate_deblur.PRESETS", {})
    facts, text = run_deblur(DeblurOptions((str(shaken),), frames=slice(0, 1)))
    assert set(facts["methods"]) == {"blurred", "inverse"}
    assert "skimage wiener: skipped" in text


def test_shifted_pictures_are_aligned_before_comparison(shaken: Path, tmp_path: Path, virest: Virest) -> None:
    """A picture shifted by a fraction of a pixel is aligned before the comparison, and its shift is reported."""
    truth = shaken / "truth" / "frames"
    moved = tmp_path / "moved"
    moved.mkdir()
    for path in sorted(truth.iterdir()):
        picture = cv2.imread(str(path))
        back = np.array([[1, 0, 7.5], [0, 1, -3.25]])
        shifted = cv2.warpAffine(picture, back, picture.shape[1::-1], flags=cv2.INTER_CUBIC)
        cv2.imwrite(str(moved / path.name), shifted)
    done = virest("evaluate", "deblur", "--restored", moved, "--reference", truth, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["frames"] == 2
    for told in facts["pictures"].values():
        np.testing.assert_allclose(told["shift_px"], [7.5, -3.25], atol=0.1)
        x0, y0, x1, y1 = told["compared_px"]
        assert (x0, y0) == (0, 4)
        assert (x1, y1) == (320 - 8, 240)
    assert facts["methods"]["restored"]["psnr_db"] > 30


def test_an_aligned_picture_is_not_moved(shaken: Path) -> None:
    """The truth compared with itself has no error; its PSNR is reported as infinite."""
    truth = shaken / "truth" / "frames"
    facts, text = run_deblur(DeblurOptions(restored=truth, reference=truth))
    assert facts["methods"]["restored"]["mse"] == 0
    assert facts["methods"]["restored"]["psnr_db"] == "inf"
    assert "inf" in text


def test_captures_without_truth_or_board_are_refused(shaken: Path, tmp_path: Path) -> None:
    """The CaptureError names what is missing."""
    with pytest.raises(CaptureError, match="methods find the board"):
        run_shutter(ShutterOptions((str(shaken),)))
    bare = tmp_path / "bare"
    shutil.copytree(shaken, bare, ignore=shutil.ignore_patterns("truth"))
    with pytest.raises(CaptureError, match="none of 2 selected frames has ground truth"):
        run_deblur(DeblurOptions((str(bare),)))


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("deblur", "--restored", "a"), 2, "need each other"),
        (("deblur", "x", "--restored", "a", "--reference", "b"), 2, "not both"),
        (("deblur", "--restored", "nowhere", "--reference", "nowhere"), 4, "nowhere"),
        (("shutter", "--board", "round"), 2, "chessboard"),
        (("shutter", "--frames", "1:3"), 2, "CAPTURE"),
        (("shutter", "nowhere"), 4, "nowhere"),
    ],
)
def test_usage_errors_have_their_exit_codes(
    arguments: tuple[str, ...], code: int, says: str, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Usage errors exit with 2, unusable folders with 4."""
    from virest.app.cli import run

    monkeypatch.chdir(tmp_path)
    assert run(["evaluate", *arguments]) == code
    assert says in capsys.readouterr().err
