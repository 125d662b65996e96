"""Restored pictures against truth: every preset gains where there is blur, and none makes any frame worse."""

from pathlib import Path

import numpy as np
import pytest
from story import process, psnrs_db, simulate

pytestmark = pytest.mark.scenario

PRESETS = ("fast", "balanced", "best")
LARGEST_LOSS_DB = 0.1
KINDS = {
    "ordinary": ("--exposure-ms 14 --rate 2.0 --noise 2 --seed 5", (2.0, 3.0, 3.5)),
    "text": ("--scene text --exposure-ms 12 --rate 2.0 --noise 1.5 --seed 6", (2.0, 3.0, 3.5)),
    "long": ("--exposure-ms 20 --rate 3.0 --noise 4 --seed 7", (1.5, 1.5, 1.5)),
    "noisy": ("--exposure-ms 12 --rate 1.6 --noise 8 --seed 8", (0.5, 0.5, 0.5)),
    "bright": ("--scene bright --exposure-ms 14 --rate 2.0 --noise 2 --seed 9", (0.1, 0.3, 1.0)),
}
"""Options, and what each preset has to gain in the mean over straightening alone, in dB."""


@pytest.mark.parametrize("kind", KINDS)
def test_every_preset_gains_and_none_makes_a_frame_worse(virest, work: Path, kind: str):
    """Each preset gains over straightening alone in the mean, and loses at most 0.1 dB on any frame."""
    options, least_db = KINDS[kind]
    capture = simulate(virest, work / kind, *f"--width 480 --height 360 --frames 4 {options}".split())
    base = process(virest, capture, work / "none", "--deblur", "none")
    base_db = psnrs_db(base, base, capture)
    for preset, least in zip(PRESETS, least_db, strict=True):
        gains_db = psnrs_db(process(virest, capture, work / preset, "--preset", preset), base, capture) - base_db
        report = f"{kind}, {preset}: {np.round(gains_db, 2)}"
        assert gains_db.min() >= -LARGEST_LOSS_DB, report
        assert gains_db.mean() >= least, report


def test_a_sharp_capture_is_left_alone(virest, work: Path):
    """Frames whose blur is below a pixel are straightened and not deblurred: no preset changes them otherwise."""
    options = "--width 320 --height 240 --frames 2 --exposure-ms 1 --rate 1 --seed 10"
    capture = simulate(virest, work / "sharp", *options.split())
    base = process(virest, capture, work / "none", "--deblur", "none")
    best = process(virest, capture, work / "best", "--preset", "best")
    for plain, line in zip(base.lines, best.lines, strict=True):
        assert line["deblur"]["method"] == "none"
        np.testing.assert_array_equal(best.picture(line), base.picture(plain))
