"""Restored pictures against truth: every preset gains where there is blur, and none makes a frame worse."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from story import process, psnrs_db, simulate

from virest.app.simulate import simulate_command

pytestmark = pytest.mark.scenario

PRESETS = ("fast", "balanced", "best")
LARGEST_LOSS_DB = 0.1
FINE, COARSE = 1.0, 0.25
"""Bits per pixel of the movie."""
HAND = {"width": 480, "height": 360, "frames": 3, "exposure_ms": 14.0, "rate_rad_s": 1.6, "noise_levels": 2.0}
KINDS: dict[str, tuple[dict[str, Any], tuple[float, float, float]]] = {
    "long": ({"exposure_ms": 25.0, "rate_rad_s": 2.4, "seed": 7, "bitrate_bits_per_px": FINE}, (2.5, 2.5, 2.5)),
    "noisy": ({"noise_levels": 6.0, "seed": 8, "bitrate_bits_per_px": FINE}, (1.0, 1.5, 2.0)),
    "bright": ({"scene": "bright", "seed": 9, "bitrate_bits_per_px": FINE}, (0.3, 0.5, 2.5)),
    "coarse": (
        {"width": 640, "height": 480, "frames": 5, "exposure_ms": 16.0, "rate_rad_s": 1.4, "noise_levels": 1.5}
        | {"seed": 640, "bitrate_bits_per_px": COARSE},
        (0.5, 0.5, 0.5),
    ),
}
"""The changed settings, and each preset's least mean gain over straightening alone, in dB."""


@pytest.mark.parametrize("kind", KINDS)
def test_every_preset_gains_and_none_makes_a_frame_worse(virest, work: Path, kind: str):
    """Each preset gains on average over straightening alone, and loses at most 0.1 dB on any frame."""
    changes, least_db = KINDS[kind]
    capture = work / kind
    simulate_command(capture, **{**HAND, **changes})
    base = process(virest, capture, work / "none", "--deblur", "none")
    base_db = psnrs_db(base, base, capture)
    complaints = []
    for preset, least in zip(PRESETS, least_db, strict=True):
        gains_db = psnrs_db(process(virest, capture, work / preset, "--preset", preset), base, capture) - base_db
        if gains_db.min() < -LARGEST_LOSS_DB or gains_db.mean() < least:
            complaints.append(f"{preset}: {np.round(gains_db, 2)}, mean {gains_db.mean():.2f}, {least} wanted")
    assert not complaints, f"{kind}: " + "; ".join(complaints)


def test_a_sharp_capture_is_not_deblurred(virest, work: Path):
    """Frames with less than a pixel of blur are straightened only: ``best`` gives the pictures of ``--deblur none``."""
    options = "--width 320 --height 240 --frames 2 --exposure-ms 1 --rate 1 --seed 10"
    capture = simulate(virest, work / "sharp", *options.split())
    base = process(virest, capture, work / "none", "--deblur", "none")
    best = process(virest, capture, work / "best", "--preset", "best")
    for plain, line in zip(base.lines, best.lines, strict=True):
        assert line["deblur"]["method"] == "none"
        np.testing.assert_array_equal(best.picture(line), base.picture(plain))
