"""A defocus in the profile that the frames contradict is not undone."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from virest.app.simulate import simulate_command
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.video import probe_movie, read_decodable_gray
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.plan_notes import NoteCode
from virest.restoration.settings import PRESETS


@pytest.mark.parametrize("true_px", [0.0, 2.0])
def test_a_defocus_is_undone_only_where_frames_lack_detail(tmp_path: Path, true_px: float) -> None:
    """The profile states 2 px; sharp frames show more detail than that leaves."""
    effects = [f"defocus={true_px}"] if true_px else []
    simulate_command(
        tmp_path / "soft", width=320, height=240, frames=24, seed=4, rate_rad_s=1.2, exposure_ms=[6.0], effects=effects,
        bitrate_bits_per_px=0.6, truth_frames=False,
    )  # fmt: skip
    capture = read_capture(tmp_path / "soft")
    profile = resolve_profile(capture)[0].with_extensions(defocus_sigma_px=2.0)
    read = partial(read_decodable_gray, capture.movie, probe_movie(capture.movie))
    plan = plan_restoration(capture, profile, PRESETS["fast"], read)
    told = [note.text for note in plan.said if note.code is NoteCode.FINER_DETAIL]
    assert plan.profile.extensions.defocus_sigma_px == true_px
    assert any("defocus" in note for note in plan.notes) is bool(true_px)
    assert bool(told) is not bool(true_px)
    assert true_px or "finer detail than the profile's defocus of 2.00 px leaves" in told[0]
