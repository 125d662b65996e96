"""A capture folder as a whole: joins, clocks, trimming, start-up, focal length, profiles, refusals."""

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
    """Indices of frames left out."""
    return [frame.index for frame in capture.frames if frame.skip_reason]


def test_sound_capture_has_nothing_to_say(writer):
    """Every frame joins, nothing is dropped or skipped, and no note is written."""
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
    """The logger's fx belongs to the sensor's long axis, which stands upright in a portrait picture."""
    metadata = read_capture(writer.write()).metadata
    assert (metadata.fx_px, metadata.fy_px) == (81.0, 80.0)
    assert metadata.readout_time_s == pytest.approx(0.02)
    writer.width, writer.height = 96, 64
    metadata = read_capture(writer.write()).metadata
    assert (metadata.fx_px, metadata.fy_px) == (80.0, 81.0)


def test_metadata_join_by_time_not_by_index(writer):
    """Spare metadata rows are left over, and frames without one take their neighbours' exposure, in either order."""
    writer.metadata_ns = [START_NS - 2 * PERIOD_NS, START_NS - PERIOD_NS, *writer.metadata_ns]
    del writer.metadata_ns[2 + 5]
    capture = read_capture(writer.write())
    assert [frame.index for frame in capture.frames if frame.iso is None] == [5]
    assert capture.frames[5].exposure_s == pytest.approx(0.005)
    assert {"metadata-missing", "metadata-spare", "exposure-interpolated"} <= codes(capture)
    assert skipped(capture) == []


def test_missing_stamp_row_is_found_by_sliding(writer):
    """A lost row of stamps costs its own frame only."""
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


def test_missing_first_stamp_under_even_spacing_is_decided_by_the_metadata(writer):
    """Where two shifts fit the stamps alike, the metadata rows say which one is right."""
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
def test_stamps_never_written_are_replaced_by_metadata(writer, content):
    """Without a clean Stop the movie's PTS are slid over the metadata rows."""
    writer.metadata_ns = [START_NS - PERIOD_NS, *writer.metadata_ns, writer.metadata_ns[-1] + PERIOD_NS]
    writer.write()
    (writer.folder / "frame_timestamps.txt").unlink()
    if content is not None:
        (writer.folder / "frame_timestamps.txt").write_text(content)
    capture = read_capture(writer.folder)
    assert capture.frames[0].timestamp_ns == START_NS
    assert len(capture.usable) == 30
    assert "no-stamps" in codes(capture)


def test_stamps_of_another_movie_are_refused_with_numbers(writer):
    """PTS and stamps that part are a clock error that says where and by how much."""
    writer.write()
    writer.stamps_ns = [START_NS + round(i * 1.05 * PERIOD_NS) for i in range(30)]
    writer.write_stamps()
    with pytest.raises(ClockError, match=r"first differ at frame 1, by 1670\.0 µs"):
        read_capture(writer.folder)


def test_stamps_that_end_early_are_said_to(writer):
    """Rows that all fit are not those of another recording."""
    writer.write()
    writer.stamps_ns = writer.stamps_ns[:5]
    writer.write_stamps()
    with pytest.raises(ClockError, match=r"matches more than 5 of them; frame_timestamps.txt lacks most of its rows"):
        read_capture(writer.folder)


def test_metadata_of_another_session_are_refused(writer):
    """Not one joining metadata row means different sessions."""
    writer.write()
    writer.metadata_ns = [time + 10**12 for time in writer.metadata_ns]
    writer.write_metadata()
    with pytest.raises(ClockError, match="no row joins"):
        read_capture(writer.folder)


def test_gyro_of_another_session_is_refused_with_both_spans(writer):
    """Samples that share no time with the frames are refused, not extrapolated."""
    writer.imu_ns = [time - 10**13 for time in writer.imu_ns]
    with pytest.raises(ClockError, match=r"gyro_accel\.csv covers 18.*frames 28670.*apart"):
        read_capture(writer.write())


def test_unknown_clock_is_shifted_by_the_mean_of_edge_epochs(writer):
    """Camera stamps of source UNKNOWN move to the IMU's clock; time zero moves with them."""
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


def test_realtime_clock_is_left_alone(writer):
    """Source REALTIME needs no shift whatever the rows say."""
    writer.write()
    (writer.folder / "edge_epochs.txt").write_text(EPOCHS.format(source="REALTIME", rows="9\t1\t5000\n"))
    capture = read_capture(writer.folder)
    assert (capture.clock_source, capture.clock_shift_ns) == ("REALTIME", 0)


def test_unknown_clock_without_rows_needs_shared_time(writer):
    """Without a difference, stamps are used as they are only if the spans overlap."""
    writer.write()
    (writer.folder / "edge_epochs.txt").write_text(EPOCHS.format(source="UNKNOWN", rows=""))
    assert "clock-shift" in codes(read_capture(writer.folder))
    writer.imu_ns = [time + 10**13 for time in writer.imu_ns]
    writer.write_gyro()
    with pytest.raises(ClockError, match="edge_epochs"):
        read_capture(writer.folder)


def test_frames_outside_the_imu_are_left_out(writer):
    """Frames count as covered with their exposure and readout, one IMU period beyond its ends."""
    first, last = writer.stamps_ns[2], writer.stamps_ns[-2] + 30_000_000
    writer.imu_ns = [time for time in writer.imu_ns if first <= time <= last]
    capture = read_capture(writer.write())
    assert skipped(capture) == [0, 1, 29]
    assert capture.frames[0].skip_codes == ("no-imu",)
    assert "before the first IMU row" in (capture.frames[0].skip_reason or "")
    assert capture.frames[0].time_s == 0.0


def test_frames_in_an_imu_gap_are_left_out_and_the_gap_named(writer):
    """A hole of the samples, or NaN rows, cost the frames that overlap it."""
    hole = writer.stamps_ns[10] + 2_000_000, writer.stamps_ns[12]
    writer.imu_ns = [time for time in writer.imu_ns if not hole[0] < time < hole[1]]
    capture = read_capture(writer.write())
    assert skipped(capture) == [10, 11, 12]
    assert len(capture.imu_gaps_s) == 1
    assert "IMU gap" in (capture.frames[11].skip_reason or "")
    assert {"imu-gap", "frames-without-imu"} <= codes(capture)


def test_imu_that_covers_no_frame_is_refused(writer):
    """Samples inside the clock's span but in no frame leave nothing to do."""
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
def test_focal_length_is_judged_against_the_long_side(writer, fx, expected, code):
    """Array pixels are refused with the fix, odd values noted, plausible ones taken."""
    writer.fx = (fx, fx)
    capture = read_capture(writer.write())
    assert capture.metadata.fx_px == expected
    assert codes(capture) == ({code} if code else set())


def test_startup_lag_from_repeated_pictures(writer):
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
    """Without turning, equal pictures are no evidence."""
    writer.repeats, writer.rate_rad_s = (2, 5, 8), 0.0
    capture = read_capture(writer.write())
    assert capture.repeats == ()
    assert capture.notes == ()


@pytest.mark.parametrize(
    ("exposure", "says"),
    [("10", "times such as 1e-08 s"), ("0.005", "times such as 5e-12 s"), ("null", "has no"), ("0", "has no")],
)
def test_exposures_in_other_units_are_not_called_missing(writer, exposure, says):
    """Milliseconds or seconds under the header of nanoseconds."""
    writer.exposure_ns = exposure
    capture = read_capture(writer.write())
    assert says in next(note.text for note in capture.notes if note.code == "exposure-unknown")


def test_a_link_to_no_movie_is_called_one(writer):
    """The advice was to rename movie.mp4 to movie.mp4."""
    writer.write()
    (writer.folder / "movie.mp4").unlink()
    (writer.folder / "movie.mp4").symlink_to("gone.mp4")
    with pytest.raises(VideoError) as caught:
        read_capture(writer.folder)
    assert "a link to a file that is not there" in caught.value.hint


def write_unix_columns(writer: CaptureWriter, lags_ms: list[int], cut: int = 0) -> None:
    """Stamps and metadata with times since 1970, the encoder's later by these; ``cut`` bytes are lost at the end."""
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
    """Encoder output that comes later than usual at first marks the frames until it has settled."""
    writer.write()
    write_unix_columns(writer, [300, 260, 200, 160, 130, *[100] * 25])
    capture = read_capture(writer.folder, look_at_pictures=False)
    assert skipped(capture) == [0, 1, 2, 3]
    assert capture.startup_lag_s == pytest.approx(0.2, abs=0.001)


@pytest.mark.parametrize("cut", [4, 12])
def test_a_cut_unix_time_is_no_startup(tmp_path, cut):
    """The last number of a truncated file made a lag of thirty years, and every frame was skipped."""
    writer = CaptureWriter(tmp_path / "short", count=12)
    writer.write()
    write_unix_columns(writer, [100] * 12, cut)
    assert len(read_capture(writer.folder, look_at_pictures=False).usable) == 12


def test_default_profile_follows_the_orientation(writer):
    """Portrait and landscape pictures get their own axes and readout direction; the rest comes from the metadata."""
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
    """The first that exists wins, and null values are filled from the metadata."""
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


def test_a_capture_whose_clock_begins_at_its_first_frame_is_whole(writer):
    """Stamps that count from 0 join like any others, and no frame moves by one."""
    shift = min(writer.stamps_ns)
    for name in ("stamps_ns", "metadata_ns", "imu_ns"):
        setattr(writer, name, [time - shift for time in getattr(writer, name)])
    capture = read_capture(writer.write())
    assert capture.notes == ()
    assert [frame.timestamp_ns for frame in capture.frames][:2] == [0, PERIOD_NS]
    assert skipped(capture) == []


@pytest.mark.parametrize("row", ["0.1,0.99,0.0", "0,0,0"])
def test_an_accelerometer_without_gravity_is_doubted(writer, row):
    """Values in g, without gravity, or of the gyroscope: said, before anything is built on them."""
    writer.write()
    lines = (writer.folder / "gyro_accel.csv").read_text().splitlines()
    writer.text("gyro_accel.csv", [lines[0], *(",".join(line.split(",")[:4]) + f",{row}" for line in lines[1:])])
    assert codes(read_capture(writer.folder)) == {"accel-implausible"}


@pytest.mark.parametrize(
    ("name", "said"),
    [("MOVIE.MOV", "'MOVIE.MOV'? rename it"), ("take.mkv", "'take.mkv'? ffmpeg"), ("a.txt", "its movie")],
)
def test_a_movie_of_another_name_is_pointed_at(writer, name, said):
    """Renamed, or put into another container, by whoever copied it."""
    folder = writer.write()
    (folder / "movie.mp4").rename(folder / name)
    with pytest.raises(VideoError, match="no such file") as caught:
        read_capture(folder)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("head", "kind"), [(b"\x1a\x45\xdf\xa3", "Matroska"), (b"RIFF\0\0\0\0AVI LIST", "AVI"), (b"text", "moov")]
)
def test_another_container_is_named(writer, head, kind):
    """With the command that puts its stream into an MP4."""
    folder = writer.write()
    (folder / "movie.mp4").write_bytes(head + bytes(1000))
    with pytest.raises(VideoError, match="cannot be opened") as caught:
        read_capture(folder)
    assert kind in caught.value.hint


def swap(writer: CaptureWriter, one: str, other: str) -> None:
    """Exchange two files' contents."""
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
    """Two files in each other's place are told by their headers."""
    writer.write()
    swap(writer, one, other)
    with pytest.raises(CaptureError, match=f"{one}|{other}"):
        read_capture(writer.folder)


@pytest.mark.parametrize(
    "name", ["movie.mp4", "gyro_accel.csv", "movie_metadata.csv", "frame_timestamps.txt", "edge_epochs.txt"]
)
@pytest.mark.parametrize("kind", ["pipe", "folder", "loop"])
def test_what_is_no_plain_file_is_refused_at_once(writer, name, kind):
    """Pipes, folders and loops of links in a file's place end in one line, without hanging."""
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
    """Each file that a capture cannot do without is named; the metadata are not among them."""
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


def test_folder_called_dot_has_a_name(writer, monkeypatch):
    """The current folder is known by its own name."""
    monkeypatch.chdir(writer.write())
    assert read_capture(os.curdir).name == "2022_09_17_10_00_00"


def test_honor_v10_lies_wholly_in_the_startup(realdata):
    """All 25 frames are later than their stamps: eight repeats, and the Unix lag falls from 337 ms."""
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
def test_real_captures_join_whole_and_show_no_false_startup(realdata, name, frames, usable):
    """Converted captures join to the last frame; none is taken for a recorder that starts."""
    capture = read_capture(realdata / name)
    assert (len(capture.frames), len(capture.usable)) == (frames, usable)
    assert capture.counts["metadata_joined"] == frames
    assert capture.startup_lag_s is None
    profile, source = resolve_profile(capture)
    assert source.endswith("camera.yaml")
    assert (profile.width, profile.height) == (capture.width, capture.height)
    assert all(math.isfinite(frame.time_s) for frame in capture.frames)
