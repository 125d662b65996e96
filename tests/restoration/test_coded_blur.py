"""A coded frame keeps the blur of the frame before where the difference is too small to be stored."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from blurred_scene import FRAME, camera, record
from laws import TurningCamera
from numpy.typing import NDArray

from virest.capture.frame_coding import FrameCoding
from virest.capture.video import probe_movie, read_gray
from virest.image_formation.kernels import kernel_field
from virest.image_formation.row_motion import RowMotion
from virest.restoration.capture import predicted_from
from virest.restoration.coded_blur import FRAMES_BACK, CodedBlur, Predicted, coded_blur
from virest.restoration.frame import restore_frame
from virest.restoration.neighbours.sights import Sight
from virest.restoration.settings import PRESETS
from virest.restoration.statistics.of_picture import measured_centres, picture_statistics
from virest.restoration.statistics.records import PictureStatistics
from virest.restoration.statistics.rings import RINGS

ALONE, FAST = np.zeros(RINGS), PRESETS["fast"]
SHAKEN, STILL = camera(reference="frame-middle"), camera(reference="frame-middle", rate_rad_s=(0.01, 0.01, 0.0))


def _statistics(recorded: NDArray[np.uint8], motion: RowMotion) -> PictureStatistics:
    field = kernel_field(motion, measured_centres(recorded, motion, None))
    return picture_statistics(recorded, field, motion.profile.curve, 8)[0]


def _blur(turning: TurningCamera, *before: tuple[TurningCamera, float], grey: bool = False) -> CodedBlur:
    """The blur of a recorded frame as coded with these steps after these frames, the nearest first."""
    picture, motion = record(turning, grey).picture, turning.motion
    predicted = [Predicted(one.motion, step) for one, step in before]
    return coded_blur(picture, motion, predicted, _statistics(picture, motion), ALONE)


def test_a_frame_coded_alone_or_after_the_same_blur_has_its_own() -> None:
    """Nothing is kept, or what is kept is the same."""
    assert _blur(SHAKEN) == CodedBlur(1.0, 1.0)
    same = _blur(SHAKEN, (SHAKEN, 40.0))
    assert same.share == pytest.approx(1.0, abs=1e-3)
    assert same.lost == pytest.approx(1.0, abs=1e-3)


def test_the_coarser_the_step_the_more_of_a_sharper_frame_is_kept() -> None:
    """From none of it to all: with nothing stored, the frame is the sharp one, and restoring it only does harm."""
    found = [_blur(SHAKEN, (STILL, step)) for step in (0.01, 4.0, 16.0, 64.0, 1e4)]
    shares, lost = [one.share for one in found], [one.lost for one in found]
    assert max(np.diff(shares)) < 0.01
    assert max(np.diff(lost)) < 0
    assert (shares[0], lost[0]) == pytest.approx((1.0, 1.0), abs=0.01)
    assert shares[-1] < 0.05
    assert lost[-1] < 0.05


def test_a_frame_may_keep_the_blur_of_the_last_frame_but_one() -> None:
    """The frame before, blurred alike, was stored as the sharp one before it: so is this one."""
    assert _blur(SHAKEN, (SHAKEN, 1e4), (STILL, 1e4)).lost < 0.05
    assert _blur(SHAKEN, (SHAKEN, 1e4), (STILL, 0.01)).lost > 0.95


def test_a_more_blurred_frame_before_promises_no_gain() -> None:
    """What the frame before has lost is not restored with this frame's kernels."""
    after = _blur(camera(rate_rad_s=(0.2, -0.4, 0.1)), (SHAKEN, 30.0))
    assert after.lost == 1.0
    assert 0 < after.share < 1


def test_the_share_is_that_which_suits_what_a_real_coder_stored(tmp_path: Path) -> None:
    """x264 codes a frame after a sharper one.

    Restored by its path, D is added to the straightened frame, of error E: ⟨E, D⟩ / |D|² of it would leave the least
    error.  Over that of the same frame coded alone with the same step, this is the share.
    """
    truth, blurred = record(SHAKEN, grey=True).truth, record(SHAKEN, grey=True).picture[..., 0]
    measured, derived = [], []
    for part in (0.3, 0.5, 0.8):
        before = camera(reference="frame-middle", rate_rad_s=(0.9 * part, -2.0 * part, 0.6 * part))
        first = record(before, grey=True).picture[..., 0]
        for qp in (20, 26, 32, 38):
            coding, (_, stored) = _coded(tmp_path / "two.mp4", [first, blurred], qp)
            _, (alone,) = _coded(tmp_path / "one.mp4", [blurred], qp - 3)  # x264 codes these with a QP lower by 3
            assert [one.from_previous for one in coding] == [False, True]
            step = coding[1].step
            measured.append(_best_share(stored, truth, step) / _best_share(alone, truth, step))
            derived.append(_blur(SHAKEN, (before, step), grey=True).share)
    assert np.mean(np.abs(np.subtract(measured, derived))) < 0.2
    assert np.corrcoef(measured, derived)[0, 1] > 0.9


def _best_share(stored: NDArray[np.uint8], truth: NDArray[np.uint8], step: float) -> float:
    inner = np.s_[40:-40, 40:-40, 1]
    straight, restored = (
        restore_frame(
            FRAME, np.repeat(stored[..., None], 3, -1), SHAKEN.motion, SHAKEN.trajectory, settings, coding_step=step
        ).picture[inner].astype(float)
        for settings in (replace(FAST, deblur="none"), FAST)
    )  # fmt: skip
    change = restored - straight
    return float(np.sum((truth[inner] - straight) * change) / np.sum(change**2))


def _coded(path: Path, pictures: list[NDArray[np.uint8]], qp: int) -> tuple[list[FrameCoding], list[NDArray[np.uint8]]]:
    """Pictures (height, width) as x264 stores them in a movie without frames that are predicted from later ones."""
    height, width = pictures[0].shape
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"qp": str(qp), "bf": "0", "aq-mode": "0", "threads": "1"}
        for picture in pictures:
            planes = [np.rint(16 + picture * (219 / 255)), np.full((height // 2, width), 128)]
            frame = av.VideoFrame.from_ndarray(np.concatenate(planes).astype(np.uint8), format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    coding: dict[int, FrameCoding] = {}
    read = dict(read_gray(path, probe_movie(path), range(len(pictures)), coding))
    return [coding[n] for n in sorted(coding)], [read[n] for n in sorted(read)]


def test_the_chain_of_prediction_ends_at_a_frame_that_is_coded_alone_or_missing() -> None:
    """Also at a frame without motion, and after FRAMES_BACK frames."""
    motion = SHAKEN.motion

    def sight(number: int, step: float | None, known: bool = True) -> Sight:
        coding = None if step is None else FrameCoding(abs(step), step > 0)
        return Sight(
            replace(FRAME, index=number), np.zeros((2, 2, 3), np.uint8), motion if known else None, "", None, coding
        )

    def steps(*sights: Sight) -> list[float]:
        return [one.step for one in predicted_from(sights[:-1], sights[-1])]

    assert steps(sight(4, 1), sight(5, 2), sight(6, 3), sight(7, 4)) == [4, 3, 2][:FRAMES_BACK]
    assert steps(sight(5, -2), sight(6, 3)) == [3]
    assert steps(sight(4, 1), sight(5, -2), sight(6, 3)) == [3]
    assert steps(sight(5, 2), sight(6, -3)) == []
    assert steps(sight(4, 2), sight(6, 3)) == []
    assert steps(sight(5, 2), sight(6, None)) == []
    assert steps(sight(5, 2, known=False), sight(6, 3)) == []
    assert steps(sight(6, 3)) == []


def test_a_frame_that_kept_the_sharp_frame_before_is_changed_less() -> None:
    """A still picture stored again, although the camera turned: restored by its path it would ring."""
    shown, settings = record(STILL).picture, replace(FAST, shutter="none", reference="frame-middle")

    def change(*predicted: Predicted) -> float:
        result = restore_frame(FRAME, shown, SHAKEN.motion, SHAKEN.trajectory, settings, predicted=predicted)
        assert result.picture is not None
        return float(np.mean((result.picture.astype(float) - shown) ** 2))

    assert change(Predicted(STILL.motion, 1e4)) < 0.6 * change()
