"""Benefit of a better model for restored frames, without ground truth."""

import dataclasses
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from virest.app.diagnose import open_source
from virest.app.simulate import simulate_command
from virest.camera.profile_file import read_profile
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.video import probe_movie, read_frames, read_gray
from virest.diagnosis.ladder import diagnose_capture
from virest.diagnosis.restoration_gain import (
    chosen_pairs,
    measure_restoration_gain,
    pairs_to_keep_back,
    shared_gradient,
)
from virest.inference.tracking import track_pairs

WHOLE = (0, 0, 320, 240)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Captures with a readout time too long in the profile, and with an unknown defocus."""

    def read(name, effect):
        folder: Path = tmp_path_factory.mktemp("gain") / name
        size = {"width": 320, "height": 240, "frames": 14, "exposure_ms": 14.0, "readout_ms": 24.0}
        simulate_command(folder, **size, rate_rad_s=1.6, seed=8, effects=[effect], crf=14.0, truth_frames=False)
        capture = read_capture(folder)
        return capture, resolve_profile(capture)[0], read_profile(folder / "truth/camera.yaml")

    return {"readout": read("readout", "readout_time=0.010"), "defocus": read("defocus", "defocus=1.6")}


def readers(capture):
    """Functions that read colour and luma of the requested frames."""
    index = probe_movie(capture.movie)
    colour = lambda numbers: (p for n in numbers for p in read_frames(capture.movie, index, n, n))  # noqa: E731
    return colour, lambda numbers: read_gray(capture.movie, index, numbers)


def textured(rng, sigma=1.2):
    """A picture of blobs, (240, 320, 3)."""
    noise = cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), sigma)
    grey = np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def shared(first, second):
    """Shared gradient energy of two complete pictures."""
    tracks = track_pairs([(4, first[..., 0].copy()), (5, second[..., 0].copy())])[0]
    return shared_gradient((first, second), (WHOLE, WHOLE), tracks)


def test_noise_does_not_count_as_sharpness(rng):
    """Independent noise raises the plain gradient energy by more than 20 % but never the shared one."""
    clean = textured(rng, 4.0)
    pair = clean, np.roll(clean, (1, 2), (0, 1))
    noise = [rng.normal(0, 10, (240, 320, 1)) for _ in pair]
    noisy = [np.clip(p + n, 0, 255).astype(np.uint8) for p, n in zip(pair, noise, strict=True)]
    own = [float(np.mean(cv2.Sobel(p[..., 0], cv2.CV_32F, 1, 0, scale=1 / 8) ** 2)) for p in (clean, noisy[0])]
    assert own[1] > 1.2 * own[0]
    assert 0.5 * shared(*pair) < shared(*noisy) < shared(*pair)


def test_blur_lowers_the_shared_gradient_energy(rng):
    """A Gaussian of 1.5 px on both pictures removes more than half of it."""
    sharp = textured(rng)
    moved = np.roll(sharp, (3, -2), (0, 1))
    soft = [cv2.GaussianBlur(picture, (0, 0), 1.5) for picture in (sharp, moved)]
    assert shared(*soft) < 0.5 * shared(sharp, moved)


def test_shared_gradient_energy_is_nan_without_alignment(rng):
    """Without tracks or a common area the result is NaN."""
    picture = textured(rng)
    assert np.isnan(shared_gradient((picture, picture), (WHOLE, WHOLE), None))
    tracks = track_pairs([(4, picture[..., 0].copy()), (5, np.roll(picture[..., 0], 1, 1).copy())])[0]
    assert np.isnan(shared_gradient((picture, picture), ((0, 0, 100, 240), (200, 0, 320, 240)), tracks))


def test_pairs_do_not_overlap_and_have_both_frames(simulated):
    """Each frame belongs to at most one pair, and a repeated frame belongs to none."""
    capture, profile, _ = simulated["readout"]
    firsts = chosen_pairs(capture, profile)
    assert len(firsts) >= 3
    assert all(b - a >= 2 for a, b in pairwise(firsts))
    assert max(firsts) + 1 < len(capture.frames)
    early = dataclasses.replace(capture, repeats=(firsts[0] + 1,))
    assert firsts[0] not in chosen_pairs(early, profile)


def test_the_right_readout_makes_neighbours_agree(simulated):
    """With the right readout time, the predicted positions of points in the next frame are accurate."""
    capture, nominal, true = simulated["readout"]
    gain = measure_restoration_gain(capture, nominal, true, *readers(capture))
    assert gain.disagreement_before_px > 0.6
    assert gain.disagreement_after_px < 0.35
    assert gain.sharpness_after > gain.sharpness_recorded
    assert len(gain.frames) == len(set(gain.frames)) >= 6


def test_the_right_blur_makes_frames_sharper(simulated):
    """Removing the defocus too gives more sharpness than removing only motion blur.

    Both are sharper than the recorded frames.
    """
    capture, nominal, true = simulated["defocus"]
    gain = measure_restoration_gain(capture, nominal, true, *readers(capture))
    assert gain.sharpness_before > gain.sharpness_recorded
    assert gain.sharpness_after > 1.08 * gain.sharpness_before
    same = measure_restoration_gain(capture, nominal, nominal, *readers(capture))
    assert (same.sharpness_before, same.disagreement_before_px) == (same.sharpness_after, same.disagreement_after_px)


def test_pairs_are_kept_back_only_from_long_captures(simulated):
    """At most a tenth of the frames is kept back; a capture of 14 frames has none to spare."""
    capture, profile, _ = simulated["readout"]
    assert pairs_to_keep_back(capture, profile) == []
    frames = [dataclasses.replace(frame, skip_reason=None, skip_codes=()) for frame in capture.frames]
    more = [dataclasses.replace(frame, index=14 + frame.index, time_s=frame.time_s) for frame in frames]
    firsts = pairs_to_keep_back(dataclasses.replace(capture, frames=(*frames, *more)), profile)
    assert len(firsts) == 1


def test_no_fit_uses_the_frames_kept_back(tmp_path):
    """Points and blur give the same results whatever these frames show."""
    folder = tmp_path / "kept"
    simulate_command(folder, width=240, height=320, frames=22, seed=3, rate_rad_s=1.0, exposure_ms=9)
    source = open_source(folder)
    firsts = pairs_to_keep_back(source.capture, source.profile)
    kept_back = [first + step for first in firsts for step in (0, 1)]
    assert kept_back

    def spoilt(numbers):
        for index, picture in source.gray(numbers):
            yield index, picture[::-1].copy() if index in kept_back else picture

    found = [
        diagnose_capture(source.capture, source.profile, source.pictures, gray, kept_back=kept)
        for gray, kept in ((source.gray, kept_back), (spoilt, kept_back))
    ]
    told = [(one.nominal.geometry_rms_px, one.nominal.blur_rms_px, len(one.causes)) for one in found]
    assert told[0] == told[1]
