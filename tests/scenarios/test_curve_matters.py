"""The effect of the response curve: the right one beats none and wrong ones, and so does the mask of clipping."""

from pathlib import Path

import numpy as np
import pytest
from story import process, truth_picture

from virest.app.bench.curves import GAMMA, clipping_rows, curve_rows
from virest.app.simulate import simulate_command

pytestmark = pytest.mark.scenario

SEEDS, FRAMES = (11,), 3


def test_the_right_knots_are_better_on_every_frame(work: Path):
    """With a fifth of the pixels in toe and shoulder, the right knots gain 0.2 dB over no curve and other knots."""
    rows = {row["told"]: row for row in curve_rows(work, "toe and shoulder", SEEDS, FRAMES)}
    assert 0.1 < sum(rows["right"]["toe_and_shoulder"]) < 0.3
    for told in ("none (linear)", "other knots", "srgb"):
        assert rows[told]["right_minus_this_db"] > 0.2
        assert rows[told]["least_right_minus_this_db"] > 0.0


def test_the_clipping_mask_makes_highlights_harmless(work: Path):
    """With 2 to 5 % of the pixels several times too bright, the mask gains 3 dB near them and 1 dB elsewhere."""
    rows = {row["told"]: row for row in clipping_rows(work, "highlights", SEEDS, FRAMES)}
    assert 0.02 < rows["without"]["clipped"] < 0.05
    for part, least_db in (("near_db", 3.0), ("whole_db", 3.0), ("elsewhere_db", 1.0)):
        assert rows["with the mask"][part] - rows["without"][part] >= least_db
        assert rows["with the mask"][part] - rows["not deblurred"][part] >= least_db
    assert rows["with the mask"]["elsewhere_db"] > rows["nothing clipped"]["elsewhere_db"] - 1.0


def test_overexposed_areas_do_not_affect_the_rest(work: Path):
    """With 3 % of the pixels slightly too bright, the rest is within 0.3 dB of the same scene in less light.

    The mask gains half a decibel near these pixels and in the whole picture, and costs nothing elsewhere.
    """
    rows = {row["told"]: row for row in clipping_rows(work, "sunlit", (*SEEDS, 12), FRAMES)}
    assert rows["with the mask"]["clipped"] == pytest.approx(0.03, abs=0.005)
    assert rows["with the mask"]["elsewhere_db"] > rows["nothing clipped"]["elsewhere_db"] - 0.3
    assert rows["with the mask"]["elsewhere_db"] > rows["without"]["elsewhere_db"] - 0.05
    for part in ("near_db", "whole_db"):
        assert rows["with the mask"][part] - rows["without"][part] >= 0.5


def test_auto_exposure_keeps_the_light_of_each_frame(virest, work: Path):
    """Under auto-exposure every frame is restored with the light of its own exposure."""
    capture = work / "auto"
    dim = "gain_drift=" + ",".join(["0.5"] * 8)  # so that the brightest exposure does not clip
    simulate_command(capture, width=480, height=360, frames=8, exposure_ms=10.0, rate_rad_s=1.4, response=GAMMA, seed=9,
                     auto_exposure_ev=2.0, bitrate_bits_per_px=1.0, effects=[dim])  # fmt: skip
    result = process(virest, capture, work / "auto-out")
    light = []
    for line in result.lines:
        assert line["status"] == "restored", line["warnings"]
        x0, y0, x1, y1 = line["valid_px"]
        pictures = (result.picture(line), truth_picture(capture, line["frame"]))
        light.append([GAMMA.linearise(picture[y0:y1, x0:x1] / 255).mean() for picture in pictures])
    restored, true = np.array(light).T
    np.testing.assert_allclose(restored, true, rtol=0.01)
    assert true.max() > 3 * true.min()
