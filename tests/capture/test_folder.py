"""A capture folder as a whole: joins, clocks, trimming, start-up, focal length, profiles and errors."""

from __future__ import annotations

import math
import os

import numpy as np
import pytest
from capture_writing import METADATA_11, PERIOD_NS, START_NS, CaptureWriter, moving_pictures, write_movie

from virest.camera.profile_file import write_profile
from virest.capture.folder import Capture, default_profile, read_capture, resolve_profile
from virest.errors import CaptureError, ClockError, ImuError, SettingsError, VideoError

EPOCHS = (
    "#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_TIMESTAMP_SOURCE is "
    "SENSOR_INFO_TIMESTAMP_SOURCE_{source}.\n#elapsedRealtimeNanos()\tnanoTime()\tDifference\n{rows}"
)


def codes(capture: Capture) -> set[str]:
    """Codes of the notes."""
    return {note.code for note in capture.notes}


def skipped(capture: Capture) -> list[int]:
    """Indices of skipped frames."""
    return [frame.index for frame in capture.frames if frame.skip_reason]


def test_an_intact_capture_has_no_notes(writer):
    """Every frame joins, and nothing is dropped or skipped."""
    capture = read_capture(writer.write())
    assert capture.notes == ()
    assert len(capture.usable) == len(capture.frames) == 30
    assert capture.name == "2022_09_17_10_00_00"
    assert (capture.clock_source, capture.clock_shift_ns) == ("not logged", 0)
    assert [frame.timestamp_ns for frame in capture.frames] == [s // 1000 * 1000 for s in writer.stamps_ns]
    np.testing.assert_allclose(capture.imu.time_s[0], -0.2)
    assert capture.frames[3].exposure_s == pytest.approx(0.005)
    assert capture.frames[3].iso == 144
    assert capture.counts["metadata_joined"] == 30


def test_portrait_focal_lengths_are_swapped(writer):
    """The logger's fx belongs to the sensor's long axis, which is vertical in a portrait frame."""
    metadata = read_capture(writer.write()).metadata
    assert (metadata.fx_px, metadata.fy_px) == (81.0, 80.0)
    assert metadata.readout_time_s == pytest.approx(0.02)
    writer.width, writer.height = 96, 64
    metadata = read_capture(writer.write()).metadata
    assert (metadata.fx_px, metadata.fy_px) == (80.0, 81.0)


def test_metadata_join_by_time_not_by_index(writer):
    """Surplus metadata rows are ignored, and a frame without a row takes its neighbours' exposure."""
    writer.metadata_ns = [START_NS - 2 * PERIOD_NS, START_NS - PERIOD_NS, *writer.metadata_ns]
    del writer.metadata_ns[2 + 5]
    capture = read_capture(writer.write())
    assert [frame.index for frame in capture.frames if frame.iso is None] == [5]
    assert capture.frames[5].exposure_s == pytest.approx(0.005)
    assert {"metadata-missing", "metadata-spare", "exposure-interpolated"} <= codes(capture)
    assert skipped(capture) == []


def test_a_missing_timestamp_row_is_found_by_alignment(writer):
    """A lost row skips only its own frame."""
    writer.write_movie()
    writer.write_metadata()
    writer.write_gyro()
    del writer.stamps_ns[12]
    writer.write_stamps()
    capture = read_capture(writer.folder)
    assert skipped(capture) == [12]
    assert capture.frames[12].skip_codes == ("no-stamp",)
    assert capture.frames[13].timestamp_ns == writer.stamps_ns[12] // 1000 * 1000
    assert "stamps-slid" in codes(capture)


def test_the_metadata_locate_a_missing_first_timestamp(writer):
    """With even spacing two alignments fit the timestamps equally well; the metadata rows decide."""
    writer.write()
    rows = [START_NS + i * PERIOD_NS for i in range(30)]
    pts = [i * PERIOD_NS for i in range(30)]
    write_movie(writer.folder / "movie.mp4", moving_pictures(30), pts)
    writer.metadata_ns = [row + 100 for row in rows]
    writer.write_metadata()
    writer.stamps_ns = rows[1:]
    writer.write_stamps()
    capture = read_capture(writer.folder)
    assert skipped(capture) == [0]
    assert capture.frames[1].time_s == 0.0


@pytest.mark.parametrize("content", [None, "", "Frame timestamp[nanosec]\n"])
def test_missing_timestamps_are_replaced_by_metadata(writer, content):
    """Without a clean stop of the recording, the movie's PTS are aligned with the metadata rows."""
    writer.metadata_ns = [START_NS - PERIOD_NS, *writer.metadata_ns, writer.metadata_ns[-1] + PERIOD_NS]
    writer.write()
    (writer.folder / "frame_timestamps.txt").unlink()
    if content is not None:
        (writer.folder / "frame_timestamps.txt").write_text(content)
    capture = read_capture(writer.folder)
    assert capture.frames[0].timestamp_ns == START_NS
    assert len(capture.usable) == 30
    assert "no-stamps" in codes(capture)


def test_timestamps_of_another_movie_are_refused(writer):
    """The clock error states where PTS and timestamps diverge and by how much."""
    writer.write()
    writer.stamps_ns = [START_NS + round(i * 1.05 * PERIOD_NS) for i in range(30)]
    writer.write_stamps()
    with pytest.raises(ClockError, match=r"first differ at frame 1, by 1670\.0 µs"):
        read_capture(writer.folder)


def test_stamps_that_end_early_are_said_to(writer):
    """If all rows match the first frames, the file is truncated, not from another recording."""
    writer.write()
    writer.stamps_ns = writer.stamps_ns[:5]
    writer.write_stamps()
    with pytest.raises(ClockError, match=r"matches more than 5 of them; frame_timestamps.txt lacks most of its rows"):
        read_capture(writer.folder)


def test_metadata_of_another_session_are_refused(writer):
    """If no metadata row joins a frame, the files are from different sessions."""
    writer.write()
    writer.metadata_ns = [time + 10**12 for time in writer.metadata_ns]
    writer.write_metadata()
    with pytest.raises(ClockError, match="no row joins"):
        read_capture(writer.folder)


def test_gyro_of_another_session_is_refused_with_both_spans(writer):
    """Samples without common time with the frames are rejected, not extrapolated."""
    writer.imu_ns = [time - 10**13 for time in writer.imu_ns]
    with pytest.raises(ClockError, match=r"gyro_accel\.csv covers 18.*frames 28670.*apart"):
        read_capture(writer.write())


def test_unknown_clock_is_shifted_by_the_mean_of_edge_epochs(writer):
    """Camera timestamps of source UNKNOWN are moved to the IMU's clock, and so is time zero."""
    shift = 22_319_000_000_000
    writer.imu_ns = [time + shift for time in writer.imu_ns]
    writer.write()
    rows = f"9\t1\t{shift - 40}\n9\t1\t{shift + 60}\n"
    (writer.folder / "edge_epochs.txt").write_text(EPOCHS.format(source="UNKNOWN", rows=rows))
    capture = read_capture(writer.folder)
    assert (capture.clock_source, capture.clock_shift_ns) == ("UNKNOWN", shift + 10)
    assert capture.frames[0].time_s == 0.0
    assert capture.frames[0].timestamp_ns == START_NS + shift + 10
    assert capture.imu.time_s[0] == pytest.approx(-0.2 - 10e-9, abs=1e-12)
    assert len(capture.usable) == 30


def test_a_realtime_clock_is_not_shifted(writer):
    """Source REALTIME needs no shift, whatever the rows contain."""
    writer.write()
    (writer.folder / "edge_epochs.txt").write_text(EPOCHS.format(source="REALTIME", rows="9\t1\t5000\n"))
    capture = read_capture(writer.folder)
    assert (capture.clock_source, capture.clock_shift_ns) == ("REALTIME", 0)


def test_an_unknown_clock_without_rows_needs_overlapping_times(writer):
    """Without a clock difference, timestamps are used unchanged only if the time spans overlap."""
    writer.write()
    (writer.folder / "edge_epochs.txt").write_text(EPOCHS.format(source="UNKNOWN", rows=""))
    assert "clock-shift" in codes(read_capture(writer.folder))
    writer.imu_ns = [time + 10**13 for time in writer.imu_ns]
    writer.write_gyro()
    with pytest.raises(ClockError, match="edge_epochs"):
        read_capture(writer.folder)


def test_frames_outside_the_imu_samples_are_skipped(writer):
    """Coverage includes exposure and readout and extends one IMU period beyond the samples."""
    first, last = writer.stamps_ns[2], writer.stamps_ns[-2] + 30_000_000
    writer.imu_ns = [time for time in writer.imu_ns if first <= time <= last]
    capture = read_capture(writer.write())
    assert skipped(capture) == [0, 1, 29]
    assert capture.frames[0].skip_codes == ("no-imu",)
    assert "before the first IMU row" in (capture.frames[0].skip_reason or "")
    assert capture.frames[0].time_s == 0.0


def test_frames_in_an_imu_gap_are_skipped_and_the_gap_is_named(writer):
    """A gap in the samples skips the frames that overlap it."""
    hole = writer.stamps_ns[10] + 2_000_000, writer.stamps_ns[12]
    writer.imu_ns = [time for time in writer.imu_ns if not hole[0] < time < hole[1]]
    capture = read_capture(writer.write())
    assert skipped(capture) == [10, 11, 12]
    assert len(capture.imu_gaps_s) == 1
    assert "IMU gap" in (capture.frames[11].skip_reason or "")
    assert {"imu-gap", "frames-without-imu"} <= codes(capture)


def test_imu_that_covers_no_frame_is_refused(writer):
    """Samples within the capture's time span that cover no frame are an error."""
    end = writer.stamps_ns[-1]
    writer.imu_ns = list(range(end - 3_000_000, end + 2_000_000, 1_000_000))
    with pytest.raises(ImuError, match="none of the 30 frames"):
        read_capture(writer.write())


@pytest.mark.parametrize(
    ("fx", "expected", "code"),
    [
        (1.0, None, "fx-unknown"),
        (211.0, None, "fx-active-array"),
        (30.0, None, "fx-active-array"),
        (120.0, 120.0, "fx-unusual"),
        (70.0, 70.0, None),
    ],
)
def test_a_logged_focal_length_is_checked_against_the_long_side(writer, fx, expected, code):
    """Array pixels are rejected, unusual values are noted, and plausible values are accepted."""
    writer.fx = (fx, fx)
    capture = read_capture(writer.write())
    assert capture.metadata.fx_px == expected
    assert codes(capture) == ({code} if code else set())


def test_start_up_lag_from_repeated_frames(writer):
    """Exact repeats while the phone turns mark all frames up to the last repeat."""
    writer.repeats = (2, 5, 8)
    capture = read_capture(writer.write())
    assert capture.repeats == (2, 5, 8)
    assert skipped(capture) == list(range(9))
    assert all(frame.only_startup for frame in capture.frames[:9])
    assert capture.startup_lag_s == pytest.approx(3 * PERIOD_NS / 1e9, rel=0.01)
    (note,) = capture.notes
    assert note.code == "content-lag"
    assert "2, 5, 8" in note.text


def test_repeats_of_a_still_phone_mean_nothing(writer):
    """Without rotation, equal frames are no evidence of a lag."""
    writer.repeats, writer.rate_rad_s = (2, 5, 8), 0.0
    capture = read_capture(writer.write())
    assert capture.repeats == ()
    assert capture.notes == ()


@pytest.mark.parametrize(
    ("exposure", "says"),
    [("10", "times such as 1e-08 s"), ("0.005", "times such as 5e-12 s"), ("null", "has no"), ("0", "has no")],
)
def test_exposures_in_other_units_are_not_called_missing(writer, exposure, says):
    """The note quotes milliseconds or seconds found under a header of nanoseconds."""
    writer.exposure_ns = exposure
    capture = read_capture(writer.write())
    assert says in next(note.text for note in capture.notes if note.code == "exposure-unknown")


@pytest.mark.parametrize(("exposure", "noted"), [("16000", True), ("40000", False)])
def test_exposures_a_thousand_times_too_short_are_doubted(writer, exposure, noted):
    """Microseconds under a header of nanoseconds are used as written, with a note that quotes the longest."""
    writer.exposure_ns = exposure
    texts = [note.text for note in read_capture(writer.write()).notes if note.code == "exposure-short"]
    assert texts == ["movie_metadata.csv has no exposure time above 16 µs (are they in the header's unit?)"] * noted


def test_a_link_to_no_movie_is_called_one(writer):
    """The hint names the missing target."""
    writer.write()
    (writer.folder / "movie.mp4").unlink()
    (writer.folder / "movie.mp4").symlink_to("gone.mp4")
    with pytest.raises(VideoError) as caught:
        read_capture(writer.folder)
    assert "a link to a file that is not there" in caught.value.hint


def write_unix_columns(writer: CaptureWriter, lags_ms: list[int], cut: int = 0) -> None:
    """Write times since 1970 to both files; the encoder's are later by ``lags_ms``, ``cut`` bytes are missing."""
    stamps = [
        f"{s // 1000 * 1000},{10**18 + s + lag * 10**6}" for s, lag in zip(writer.stamps_ns, lags_ms, strict=True)
    ]
    path = writer.text("frame_timestamps.txt", ["Frame timestamp[nanosec],Unix time[nanosec]", *stamps])
    path.write_bytes(path.read_bytes()[: -cut or None])
    rows = [
        f"{t},80,80,{n},5000000,33333333,20000000,144,3.95,0.1,3,{10**18 + t}" for n, t in enumerate(writer.metadata_ns)
    ]
    writer.text("movie_metadata.csv", [METADATA_11 + ",Unix time[nanosec]", *rows])


def test_startup_lag_from_unix_columns_alone(writer):
    """Frames that leave the encoder later than usual are marked until the delay has settled."""
    writer.write()
    write_unix_columns(writer, [300, 260, 200, 160, 130, *[100] * 25])
    capture = read_capture(writer.folder, look_at_pictures=False)
    assert skipped(capture) == [0, 1, 2, 3]
    assert capture.startup_lag_s == pytest.approx(0.2, abs=0.001)


@pytest.mark.parametrize("cut", [4, 12])
def test_a_cut_unix_time_is_no_startup(tmp_path, cut):
    """The truncated last number is ignored: as a lag of thirty years it would mark every frame as start-up."""
    writer = CaptureWriter(tmp_path / "short", count=12)
    writer.write()
    write_unix_columns(writer, [100] * 12, cut)
    assert len(read_capture(writer.folder, look_at_pictures=False).usable) == 12


def test_default_profile_follows_the_orientation(writer):
    """Portrait and landscape frames have different axes and readout directions; other values come from the metadata."""
    profile = default_profile(read_capture(writer.write()))
    assert profile.shutter.readout_direction == "right_to_left"
    assert profile.r_cam_imu == ((1, 0, 0), (0, -1, 0), (0, 0, -1))
    assert (profile.readout_known, profile.shutter.readout_time_s) == (True, pytest.approx(0.02))
    assert profile.intrinsics is not None
    assert (profile.intrinsics.fy_px, profile.intrinsics.cx_px) == (80.0, 31.5)
    assert profile.response is None
    assert profile.time_offset_s is None
    writer.width, writer.height, writer.readout_ns = 96, 64, "null"
    profile = default_profile(read_capture(writer.write()))
    assert profile.shutter.readout_direction == "top_to_bottom"
    assert profile.r_cam_imu == ((0, -1, 0), (-1, 0, 0), (0, 0, -1))
    assert not profile.readout_known


def test_profile_comes_from_config_then_folder_then_metadata(writer, tmp_path):
    """The first one that exists is used, and its null values are filled from the metadata."""
    capture = read_capture(writer.write())
    profile, source = resolve_profile(capture, None)
    assert "metadata" in source
    (writer.folder / "camera.yaml").write_text("virest_profile: 1\nimage: {width: 64, height: 96}\n")
    profile, source = resolve_profile(capture, None)
    assert source.endswith("camera.yaml")
    assert profile.intrinsics is not None
    assert profile.readout_known
    assert set(profile.estimates) == {"fx_px", "readout_time_s"}
    write_profile(profile, tmp_path / "mine.yaml")
    assert resolve_profile(capture, tmp_path / "mine.yaml")[1].endswith("mine.yaml")
    (tmp_path / "mine.yaml").write_text("virest_profile: 1\nimage: {width: 96, height: 64}\n")
    with pytest.raises(SettingsError, match=r"96x64.*64x96"):
        resolve_profile(capture, tmp_path / "mine.yaml")


def test_a_capture_whose_clock_starts_at_zero_is_intact(writer):
    """Timestamps that count from 0 join like any others, and no frame shifts."""
    shift = min(writer.stamps_ns)
    for name in ("stamps_ns", "metadata_ns", "imu_ns"):
        setattr(writer, name, [time - shift for time in getattr(writer, name)])
    capture = read_capture(writer.write())
    assert capture.notes == ()
    assert [frame.timestamp_ns for frame in capture.frames][:2] == [0, PERIOD_NS]
    assert skipped(capture) == []


@pytest.mark.parametrize("row", ["0.1,0.99,0.0", "0,0,0"])
def test_an_accelerometer_without_gravity_is_noted(writer, row):
    """Values in g or without gravity give a note."""
    writer.write()
    lines = (writer.folder / "gyro_accel.csv").read_text().splitlines()
    writer.text("gyro_accel.csv", [lines[0], *(",".join(line.split(",")[:4]) + f",{row}" for line in lines[1:])])
    assert codes(read_capture(writer.folder)) == {"accel-implausible"}


@pytest.mark.parametrize(
    ("name", "said"),
    [("MOVIE.MOV", "'MOVIE.MOV'? rename it"), ("take.mkv", "'take.mkv'? ffmpeg"), ("a.txt", "its movie")],
)
def test_the_error_for_a_missing_movie_suggests_a_file(writer, name, said):
    """The movie may have been renamed or put into another container."""
    folder = writer.write()
    (folder / "movie.mp4").rename(folder / name)
    with pytest.raises(VideoError, match="no such file") as caught:
        read_capture(folder)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("head", "kind"), [(b"\x1a\x45\xdf\xa3", "Matroska"), (b"RIFF\0\0\0\0AVI LIST", "AVI"), (b"text", "moov")]
)
def test_another_container_is_named(writer, head, kind):
    """The hint names the container or the missing part."""
    folder = writer.write()
    (folder / "movie.mp4").write_bytes(head + bytes(1000))
    with pytest.raises(VideoError, match="cannot be opened") as caught:
        read_capture(folder)
    assert kind in caught.value.hint


def swap(writer: CaptureWriter, one: str, other: str) -> None:
    """Exchange the contents of two files."""
    left, right = writer.folder / one, writer.folder / other
    content = left.read_bytes(), right.read_bytes()
    left.write_bytes(content[1])
    right.write_bytes(content[0])


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("gyro_accel.csv", "movie_metadata.csv"),
        ("movie_metadata.csv", "frame_timestamps.txt"),
        ("gyro_accel.csv", "frame_timestamps.txt"),
        ("movie.mp4", "movie_metadata.csv"),
    ],
)
def test_swapped_files_are_named(writer, one, other):
    """Two swapped files are recognised by their headers."""
    writer.write()
    swap(writer, one, other)
    with pytest.raises(CaptureError, match=f"{one}|{other}"):
        read_capture(writer.folder)


@pytest.mark.parametrize(
    "name", ["movie.mp4", "gyro_accel.csv", "movie_metadata.csv", "frame_timestamps.txt", "edge_epochs.txt"]
)
@pytest.mark.parametrize("kind", ["pipe", "folder", "loop"])
def test_a_special_file_is_refused_at_once(writer, name, kind):
    """Pipes, folders and link loops in place of a file give an error without hanging."""
    writer.write()
    path = writer.folder / name
    path.unlink(missing_ok=True)
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case _:
            path.symlink_to(path)
    with pytest.raises(CaptureError, match=name):
        read_capture(writer.folder)


def test_missing_files_are_named(writer, tmp_path):
    """Each required file is named; the metadata are optional."""
    writer.write()
    (writer.folder / "movie_metadata.csv").unlink()
    capture = read_capture(writer.folder)
    assert "no-metadata" in codes(capture)
    assert capture.frames[0].exposure_s is None
    (writer.folder / "frame_timestamps.txt").unlink()
    with pytest.raises(ClockError, match="frame_timestamps"):
        read_capture(writer.folder)
    writer.write_stamps()
    (writer.folder / "gyro_accel.csv").unlink()
    with pytest.raises(ImuError, match="gyro_accel"):
        read_capture(writer.folder)
    writer.write_gyro()
    (writer.folder / "movie.mp4").unlink()
    with pytest.raises(VideoError, match="movie"):
        read_capture(writer.folder)
    for place in (tmp_path / "none", tmp_path / "\0", tmp_path):
        with pytest.raises(CaptureError):
            read_capture(place)


def test_the_current_folder_has_a_name(writer, monkeypatch):
    """A capture given as ``.`` has the folder's own name."""
    monkeypatch.chdir(writer.write())
    assert read_capture(os.curdir).name == "2022_09_17_10_00_00"


def test_honor_v10_lies_completely_in_the_start_up(realdata):
    """All 25 frames lag their timestamps: there are eight repeats, and the Unix lag falls from 337 ms."""
    capture = read_capture(realdata / "honor_v10")
    assert capture.repeats == (2, 5, 11, 14, 16, 18, 21, 23)
    assert all("start-up" in frame.skip_codes for frame in capture.frames)
    assert [frame.index for frame in capture.frames if "no-imu" in frame.skip_codes] == [0, 1]
    note = next(note for note in capture.notes if note.code == "content-lag")
    assert "2, 5, 11, 14, 16, 18, 21, 23" in note.text
    assert "337" in note.text
    assert capture.startup_lag_s is not None
    assert 0.2 < capture.startup_lag_s < 0.34
    assert capture.metadata.fx_px == 980.4812


@pytest.mark.parametrize(
    ("name", "frames", "usable"),
    [("lhaippp_car", 103, 103), ("nexus5_162941", 152, 152), ("gopro_karma", 362, 361), ("gopro_hero7", 352, 328)],
)
def test_real_captures_join_completely_and_show_no_false_start_up(realdata, name, frames, usable):
    """Converted captures join up to the last frame, and no recorder start-up is reported."""
    capture = read_capture(realdata / name)
    assert (len(capture.frames), len(capture.usable)) == (frames, usable)
    assert capture.counts["metadata_joined"] == frames
    assert capture.startup_lag_s is None
    profile, source = resolve_profile(capture)
    assert source.endswith("camera.yaml")
    assert (profile.width, profile.height) == (capture.width, capture.height)
    assert all(math.isfinite(frame.time_s) for frame in capture.frames)
