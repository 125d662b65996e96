"""Segments: the same cuts for any number of jobs, repeatable, and a frame's failure affects only that frame."""

import json
import os
import pickle
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from virest.app import jobs, segments
from virest.app.jobs import PrefetchedCalls, Workers, run_segments
from virest.app.run_folder import RunFolder
from virest.app.segments import Segment, cut_frames, cut_imu, run_or_fail_segment, run_segment
from virest.camera.profile import CameraProfile
from virest.capture.folder import Frame
from virest.capture.imu import ImuSamples
from virest.capture.video import MovieIndex
from virest.errors import OutputError, RestorationError, VideoError
from virest.restoration.capture import RestorationPlan
from virest.restoration.frame import RestoredFrame
from virest.restoration.settings import RestorationSettings

HEIGHT, WIDTH = 6, 10


def frames_of(*indices: int) -> list[Frame]:
    """Frames at 30 per second."""
    return [Frame(i, 10**9 + i * 33_000_000, i * 0.033, 0.01) for i in indices]


def grey(index: int) -> np.ndarray:
    """The decoded picture of a frame: its index as grey level."""
    return np.full((HEIGHT, WIDTH, 3), index, np.uint8)


@pytest.fixture
def segment(tmp_path: Path) -> Segment:
    """Frames 4 to 7; frame 6 is skipped."""
    frames = frames_of(4, 5, 7)
    frames.insert(2, Frame(6, 10**9, 0.198, 0.01, skip_reason="inside an IMU gap"))
    imu = ImuSamples(np.arange(0, 1, 0.01), np.zeros((100, 3)), np.zeros((100, 3)))
    index = MovieIndex(WIDTH, HEIGHT, Fraction(1, 90000), np.arange(10) * 3000, (0,), (0,))
    plan = RestorationPlan(CameraProfile(WIDTH, HEIGHT), RestorationSettings(), (), None)
    run = RunFolder(tmp_path / "trip")
    run.frames.mkdir(parents=True)
    run.segments.mkdir()
    return Segment("trip", tmp_path / "movie.mp4", index, tuple(frames), imu, plan, run)


@pytest.fixture
def decoder(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Install a decoder that cannot decode certain frames or ends early."""

    def install(broken: tuple[int, ...] = (), ends_at: int | None = None) -> None:
        def read(path: Path, index: MovieIndex, first: int, last: int, *_: Any) -> Iterator[tuple[int, Any]]:
            for i in range(first, last + 1):
                if i == ends_at:
                    raise VideoError("movie.mp4: ends")
                yield i, None if i in broken else grey(i)

        monkeypatch.setattr(segments, "read_frames", read)

    install()
    return install


def restore_all(frames: Any, imu: ImuSamples, plan: RestorationPlan, *_: Any) -> Iterator[RestoredFrame]:
    """A substitute for the restoration: adds 100 to each pixel."""
    for frame, picture in frames:
        yield RestoredFrame(frame, "restored", picture + 100, valid_px=(0, 0, WIDTH, HEIGHT), seconds={"deblur": 0.5})


@pytest.fixture
def restoration(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """Install a substitute for the restoration."""

    def install(function: Any) -> None:
        monkeypatch.setattr(segments, "restore_frames", function)

    install(restore_all)
    return install


def lines_of(segment: Segment) -> list[dict[str, Any]]:
    """Read a segment's log."""
    return [json.loads(line) for line in segment.log_path.read_text().splitlines()]


def statuses(segment: Segment) -> list[str]:
    """Each frame's status."""
    return [line["status"] for line in lines_of(segment)]


def pictures(segment: Segment) -> set[str]:
    """Names of the written pictures."""
    return {path.name for path in segment.run.frames.iterdir()}


# ── cutting ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_cuts_lie_at_key_frames_and_keep_segments_short() -> None:
    """Every frame is in one segment, in order; key frames start segments unless those would be very short."""
    parts = cut_frames(frames_of(*range(70)), (0, 12, 24, 54))
    assert [frame.index for part in parts for frame in part] == list(range(70))
    assert [part[0].index for part in parts] == [0, 10, 20, 30, 40, 50, 63]
    assert [part[0].index for part in cut_frames(frames_of(*range(24)), (0, 8, 16))] == [0, 8, 16]


def test_segments_grow_with_the_distance_from_the_key_frame() -> None:
    """Longer segments avoid decoding a movie with one key frame again and again for a few frames."""
    lengths = [len(part) for part in cut_frames(frames_of(*range(300)), (0,))]
    assert lengths[:4] == [10, 10, 10, 15]
    assert max(lengths) == 30


def test_cuts_of_every_fifth_frame_follow_skipped_key_frames() -> None:
    """A key frame between two selected frames is as good as one at the second."""
    parts = cut_frames(frames_of(*range(0, 100, 5)), (0, 48))
    assert [part[0].index for part in parts] == [0, 50]


def test_no_frames_make_no_segments() -> None:
    """An empty selection needs no work."""
    assert cut_frames([], (0,)) == []


def test_imu_samples_cover_the_frames_on_the_imus_clock() -> None:
    """The clock offset is applied before samples are cut, and the cut keeps a margin of 1 s on both sides."""
    imu = ImuSamples(np.arange(0, 100, 0.01), np.zeros((10000, 3)), np.zeros((10000, 3)))
    plan = RestorationPlan(CameraProfile(64, 48, time_offset_s=50.0), RestorationSettings(), (), None)
    cut = cut_imu(imu, frames_of(0, 30), plan)
    assert 48.8 < cut.time_s[0] < 49.0
    assert 51.9 < cut.time_s[-1] < 52.2


def test_the_whole_log_tells_the_noise_of_a_gyroscope_with_a_low_pass() -> None:
    """The filter is undone on denoised samples, so with part of the log a frame would depend on the selection."""
    imu = ImuSamples(np.arange(0, 100, 0.01), np.zeros((10000, 3)), np.zeros((10000, 3)))
    profile = CameraProfile(64, 48, time_offset_s=50.0).with_extensions(gyro_lowpass_hz=20.0)
    assert len(cut_imu(imu, frames_of(0, 30), RestorationPlan(profile, RestorationSettings(), (), None))) == len(imu)


def test_a_segment_can_be_pickled(segment: Segment) -> None:
    """It can be sent to a worker on another machine."""
    again = pickle.loads(pickle.dumps(segment))
    assert again.frames == segment.frames
    assert again.plan == segment.plan


# ── one segment ──────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.usefixtures("decoder", "restoration")
def test_each_frame_of_a_segment_has_its_line(segment: Segment) -> None:
    """Lines come in frame order with all documented keys; only frames with a picture have an output."""
    assert run_segment(segment) == {"restored": 3, "skipped": 1}
    lines = lines_of(segment)
    assert [line["frame"] for line in lines] == [4, 5, 6, 7]
    assert [line["output"] for line in lines] == ["frames/000004.png", "frames/000005.png", None, "frames/000007.png"]
    assert lines[2]["warnings"] == ["inside an IMU gap"]
    for line in lines:
        assert list(line) == [
            "capture", "frame", "timestamp_ns", "exposure_s", "status", "done", "output", "warnings", "valid_px",
            "motion", "depth_m", "depth_source", "blur", "shutter", "response", "deblur", "seconds",
        ]  # fmt: skip
        assert set(line["seconds"]) == {"decode", "estimate", "deblur", "shutter", "write"}
    assert pictures(segment) == {"000004.png", "000005.png", "000007.png"}


@pytest.mark.usefixtures("decoder", "restoration")
def test_a_segment_processed_twice_gives_the_same_files(segment: Segment) -> None:
    """Processing a segment again writes the same bytes."""
    run_segment(segment)
    before = {path.name: path.read_bytes() for path in segment.run.frames.iterdir()}
    run_segment(segment)
    assert {path.name: path.read_bytes() for path in segment.run.frames.iterdir()} == before


@pytest.mark.usefixtures("restoration")
def test_a_frame_that_cannot_be_decoded_fails_alone(segment: Segment, decoder: Callable[..., None]) -> None:
    """Its line gives the reason; the other frames are restored."""
    decoder(broken=(5,))
    assert run_segment(segment) == {"restored": 2, "skipped": 1, "failed": 1}
    assert statuses(segment) == ["restored", "failed", "skipped", "restored"]
    assert "decoded" in lines_of(segment)[1]["warnings"][0]


@pytest.mark.usefixtures("restoration")
def test_a_movie_that_ends_early_fails_its_last_frames(segment: Segment, decoder: Callable[..., None]) -> None:
    """Frames that could be decoded are restored."""
    decoder(ends_at=7)
    run_segment(segment)
    assert statuses(segment) == ["restored", "restored", "skipped", "failed"]


@pytest.mark.usefixtures("decoder")
@pytest.mark.parametrize("look_ahead", [False, True])
def test_a_frame_that_cannot_be_restored_fails_alone(
    segment: Segment, restoration: Callable[[Any], None], *, look_ahead: bool
) -> None:
    """The restoration may have read later frames already."""

    def restore(frames: Any, imu: ImuSamples, plan: RestorationPlan, *_: Any) -> Iterator[RestoredFrame]:
        for frame, picture in list(frames) if look_ahead else frames:
            if frame.index == 5:
                raise RestorationError("kernel is singular")
            yield from restore_all([(frame, picture)], imu, plan)

    restoration(restore)
    run_segment(segment)
    assert statuses(segment) == ["restored", "failed", "skipped", "restored"]
    assert lines_of(segment)[1]["warnings"] == ["kernel is singular"]
    assert pictures(segment) == {"000004.png", "000007.png"}


@pytest.mark.usefixtures("decoder", "restoration")
def test_a_full_disk_ends_the_segment_and_leaves_no_log(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk error is not attributed to a frame."""

    def full(path: Path, data: bytes) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("virest.app.outputs._write_bytes", full)
    with pytest.raises(OutputError, match="No space left"):
        run_segment(segment)
    assert not segment.log_path.exists()
    assert pictures(segment) == set()


@pytest.mark.usefixtures("decoder", "restoration")
def test_a_worker_that_outlives_its_run_writes_nothing(segment: Segment) -> None:
    """A worker cut off from its cluster goes on, while the run is resumed and finished elsewhere."""
    segment.run.segments.rmdir()
    with pytest.raises(OutputError, match="no longer there"):
        run_segment(segment)
    assert pictures(segment) == set()


@pytest.mark.usefixtures("restoration")
def test_a_fault_within_a_segment_is_written_where_it_happens(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frames' lines say what happened; skipped frames stay skipped."""
    monkeypatch.setattr(segments, "read_frames", None)
    assert run_or_fail_segment(segment) == {"failed": 3, "skipped": 1}
    assert "NoneType" in lines_of(segment)[0]["warnings"][0]


def test_a_connection_that_breaks_is_no_fault_of_the_frames(segment: Segment) -> None:
    """A cluster may lose a result that a worker has computed: the segment is lost, its frames have not failed."""
    future: Future[dict[str, int]] = Future()
    future.set_exception(OSError("Timed out during handshake while connecting"))
    assert jobs._collect(future, segment, Workers(1)) is None
    assert not segment.log_path.exists()


# ── many segments ────────────────────────────────────────────────────────────────────────────────────────────────


def one_frame_segments(segment: Segment, count: int) -> list[Segment]:
    """Segments of one frame each."""
    fields = {name: getattr(segment, name) for name in Segment.__slots__}
    return [Segment(**{**fields, "frames": (frame,)}) for frame in frames_of(*range(count))]


@pytest.mark.usefixtures("decoder", "restoration")
def test_segments_are_created_on_demand(segment: Segment) -> None:
    """Memory does not grow with the movie: there are no more segments in flight than slots."""
    made: list[int] = []

    def make() -> Iterator[Segment]:
        for part in one_frame_segments(segment, 6):
            made.append(part.frames[0].index)
            yield part

    for count, _ in enumerate(run_segments(make(), Workers(1)), start=1):
        assert len(made) <= count + 1
    assert made == list(range(6))


@pytest.mark.usefixtures("decoder")
def test_an_internal_error_fails_one_segment(segment: Segment, restoration: Callable[[Any], None]) -> None:
    """The other segments are restored."""

    def restore(frames: Any, imu: ImuSamples, plan: RestorationPlan, *_: Any) -> Iterator[RestoredFrame]:
        for frame, picture in frames:
            yield from restore_all([(frame, picture)], imu, plan)
            if frame.index == 1:
                raise ZeroDivisionError("after the frame")

    restoration(restore)
    results = [counts for _, counts in run_segments(iter(one_frame_segments(segment, 3)), Workers(1))]
    assert results == [{"restored": 1}, {"failed": 1}, {"restored": 1}]
    assert pictures(segment) == {"000000.png", "000002.png"}


def _die_on_second(segment: Segment) -> dict[str, int]:
    if segment.frames[0].index == 2:
        os._exit(1)
    return segments.fail_segment(segment, "stand-in for work")


@pytest.mark.scenario
def test_a_dying_worker_fails_only_its_own_segment(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lost segments are retried one at a time; only the one that kills its worker again fails for that reason."""
    monkeypatch.setattr(jobs, "run_or_fail_segment", _die_on_second)
    workers = Workers(2)
    parts = one_frame_segments(segment, 5)
    done = {part.frames[0].index: counts for part, counts in run_segments(iter(parts), workers)}
    workers.kill()
    assert done == {i: {"failed": 1} for i in range(5)}
    reasons = [json.loads(part.log_path.read_text())["warnings"][0] for part in parts]
    assert ["died" in reason for reason in reasons] == [False, False, True, False, False]


# ── prefetched calls ─────────────────────────────────────────────────────────────────────────────────────────────


def _square_or_die(number: int) -> int:
    if number == 2:
        os._exit(1)
    if number == 3:
        raise VideoError("movie.mp4: is empty")
    return number**2


@pytest.mark.scenario
def test_a_call_that_kills_its_worker_fails_only_itself() -> None:
    """The results of the other calls arrive in order; an error is raised when its result is requested."""
    workers = Workers(2)
    ahead = PrefetchedCalls(_square_or_die, [(number,) for number in range(6)], workers)
    results: list[Any] = []
    try:
        for number in range(6):
            try:
                results.append(ahead.result(number, "trip"))
            except (RestorationError, VideoError) as error:
                results.append(type(error))
    finally:
        workers.kill()
    assert results == [0, 1, RestorationError, VideoError, *(number**2 for number in range(4, 6))]
