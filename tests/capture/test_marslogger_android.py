"""Files of MARSLogger for Android in all variants it has written."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from virest.capture import files
from virest.capture.marslogger_android import (
    read_edge_epochs,
    read_frame_timestamps,
    read_gyro_accel,
    read_movie_metadata,
)
from virest.capture.tables import strictly_rising
from virest.errors import CaptureError, ClockError, ImuError

GYRO_TIGHT = "Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2]"
GYRO_SPACED = GYRO_TIGHT.replace(",", ", ")
T = 28_670_386_486_113


def put(tmp_path: Path, text: str, name: str = "table.txt") -> Path:
    """Write a table's text unchanged."""
    path = tmp_path / name
    path.write_bytes(text.encode())
    return path


GYRO_VARIANTS = {
    "7 columns, spaced header": (GYRO_SPACED, "0.1,-0.2,8.2030473E-4,1.0,9.8,-0.5"),
    "7 columns, spaced rows": (GYRO_SPACED, " 0.1, -0.2, 0.00082030473, 1.0, 9.8, -0.5"),
    "8 columns": (GYRO_TIGHT + ",Unix time[nanosec]", "0.1,-0.2,8.2030473E-4,1.0,9.8,-0.5,1663406447940000000"),
    "11 columns": (
        GYRO_TIGHT + ",mx[uT],my[uT],mz[uT],Unix time[nanosec]",
        "0.1,-0.2,8.2030473E-4,1.0,9.8,-0.5,11,22,33,1663406447940000000",
    ),
    "position build before a fix": (
        GYRO_TIGHT + ",lat[deg],lon[deg],alt[deg],Unix time[nanosec]",
        "0.1,-0.2,8.2030473E-4,1.0,9.8,-0.5,1663406447940000000",
    ),
    "position build after a fix": (
        GYRO_TIGHT + ",lat[deg],lon[deg],alt[deg],Unix time[nanosec]",
        "0.1,-0.2,8.2030473E-4,1.0,9.8,-0.5,40.1,-83.2,220.5,-0.5,1663406447940000000",
    ),
}


@pytest.mark.parametrize("variant", GYRO_VARIANTS)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_gyro_reads_every_variant(tmp_path, variant, end):
    """Time, rates and accelerations are the same for each header and row layout, with exact nanoseconds."""
    header, row = GYRO_VARIANTS[variant]
    lines = [header, f"{T},{row}", f"{T + 5_000_001},{row}"]
    table = read_gyro_accel(put(tmp_path, end.join(lines) + end))
    assert table.time_ns.tolist() == [T, T + 5_000_001]
    np.testing.assert_allclose(table.gyro_rad_s[1], [0.1, -0.2, 8.2030473e-4])
    np.testing.assert_allclose(table.accel_m_s2[1], [1.0, 9.8, -0.5])
    assert table.dropped == {}


def test_gyro_counts_every_dropped_row_with_its_reason(tmp_path):
    """Repeated headers, null and NaN rates, wrong times, damaged and truncated rows are counted separately."""
    row = "0.1,0.2,0.3,1,2,3"
    lines = [
        GYRO_SPACED,
        f"{T},{row}",
        f"{T},{row}",
        f"{T},0.1,0.2,0.3,1,2,4",
        f"{T + 5},{row}",
        GYRO_SPACED,
        f"{T + 3},{row}",
        f"{T + 7},null,0.2,0.3,1,2,3",
        f"{T + 8},NaN,0.2,0.3,1,2,3",
        f"{T + 9},0.1,900.0,0.3,1,2,3",
        f"0,{row}",
        "\ufffd\x07garbage",
        f"{T + 10}," + "1," * 40 + "1",
        f"{T + 11},{row}",
        "28670386",
    ]
    table = read_gyro_accel(put(tmp_path, "\n".join(lines)))
    assert table.time_ns.tolist() == [T, T + 5, T + 11]
    assert table.dropped == {
        "header repeated": 1,
        "row written twice": 1,
        "time equals its predecessor's": 1,
        "time falls or leaps": 1,
        "gyroscope null or NaN": 2,
        "rate above 200 rad/s": 1,
        "time is zero or negative": 1,
        "cut or unreadable row": 3,
    }
    assert table.rows == len(table.time_ns) + sum(table.dropped.values())


def test_rows_written_twice_are_read_once(tmp_path):
    """A log that repeats every row has lost nothing, unlike one that repeats only its times."""
    rows = [f"{T + 5_000_000 * k},0.{k},0.2,0.3,null,null,null" for k in range(4)]
    table = read_gyro_accel(put(tmp_path, "\n".join([GYRO_TIGHT, *(row for row in rows for _ in range(2))]) + "\n"))
    assert table.time_ns.tolist() == [T + 5_000_000 * k for k in range(4)]
    assert table.dropped == {"row written twice": 4}
    coarse = [f"{T + 5_000_000 * (k // 2)},0.{k},0.2,0.3,1,2,3" for k in range(8)]
    with pytest.raises(ClockError, match="only 4 of 8"):
        read_gyro_accel(put(tmp_path, "\n".join([GYRO_TIGHT, *coarse]) + "\n"))


def test_a_clock_that_begins_at_zero_keeps_its_first_times(tmp_path):
    """Converted captures count from their first frame: 0 is then a valid time, and gyroscope times may be negative."""
    stamps = read_frame_timestamps(put(tmp_path, "Frame timestamp[nanosec]\n0\n33333000\n66666000\n"))
    assert stamps.time_ns.tolist() == [0, 33_333_000, 66_666_000]
    rows = [f"{5_000_000 * k},0.{k + 3},0.2,0.3,1,2,3" for k in range(-3, 4)]
    table = read_gyro_accel(put(tmp_path, "\n".join([GYRO_TIGHT, *rows]) + "\n"))
    assert table.time_ns.tolist() == [5_000_000 * k for k in range(-3, 4)]
    lost = read_frame_timestamps(put(tmp_path, f"Frame timestamp[nanosec]\n0\n{T}\n{T + 33_333_000}\n"))
    assert lost.time_ns.tolist() == [T, T + 33_333_000]
    assert lost.dropped == {"time is zero or negative": 1}


def test_a_last_row_without_a_line_end_is_dropped(tmp_path):
    """Its last number may be truncated and still be readable."""
    table = read_gyro_accel(put(tmp_path, f"{GYRO_TIGHT}\n1,1,1,1,1,1,1\n2,1,1,1,1,1,1\n3,1,1,1,1,1,1.7"))
    assert table.time_ns.tolist() == [1, 2]
    assert table.dropped == {"last line without its end": 1}


def test_a_null_accelerometer_becomes_nan(tmp_path):
    """The rates of a phone without accelerometer values are kept."""
    table = read_gyro_accel(put(tmp_path, f"{GYRO_TIGHT}\n1,1,2,3,null,null,null\n2,1,2,3,null,null,null\n"))
    assert np.isnan(table.accel_m_s2).all()
    assert len(table.time_ns) == 2


@pytest.mark.parametrize(
    "first",
    [
        "The device may not have a gyroscope or an accelerometer!\nNo IMU data will be logged.\nHas Gyroscope? No\n",
        "Has Gyroscope? No\nHas Accelerometer? Yes\n",
    ],
)
def test_a_phone_without_gyroscope_is_named(tmp_path, first):
    """The logger's own remark becomes the error instead of a parse failure."""
    with pytest.raises(ImuError, match="no gyroscope"):
        read_gyro_accel(put(tmp_path, first))


@pytest.mark.parametrize("time", ["9.02746E+13", "28670386486113.5", "2.867E13", "2,8"])
def test_spreadsheet_times_are_refused(tmp_path, time):
    """A time that a spreadsheet has rounded is a clock error."""
    if "," in time:
        text = GYRO_TIGHT.replace(",", ";") + "\n1;1;1;1;1;1;1\n"
    else:
        text = f"{GYRO_TIGHT}\n{T},1,1,1,1,1,1\n{time},1,1,1,1,1,1\n"
    with pytest.raises(ClockError, match="spreadsheet"):
        read_gyro_accel(put(tmp_path, text))


def test_tabs_for_commas_are_refused(tmp_path):
    """The error for a file saved again with tabs names the tabs."""
    with pytest.raises(ClockError, match="tabs"):
        read_gyro_accel(put(tmp_path, GYRO_TIGHT.replace(",", "\t") + "\n1\t1\t1\t1\t1\t1\t1\n"))


METADATA_HEADERS = {
    "2019-06-14": (
        "Timestamp[ns],frame No.,exposureTime[ns],sensorFrameDuration[ns],frameReadoutTime[ns],ISO,focal length,"
        "focus dist,AF mode",
        "{t},205,10000000,33333333,20733000,144,3.95,0.16,3",
    ),
    "2019-06-15": (
        "Timestamp[nanosec],Frame No.,Exposure time[nanosec],Sensor frame duration[nanosec],"
        "Frame readout time[nanosec],ISO,Focal length,Focus distance,AF mode",
        "{t},205,10000000,33333333,20733000,144,3.95,0.16,3",
    ),
    "v1": (
        "Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],Sensor frame duration[nanosec],"
        "Frame readout time[nanosec],ISO,Focal length,Focus distance,AF mode",
        "{t},980.4,981.5,205,10000000,33333333,20733000,144,3.95,0.16,3",
    ),
    "unix": (
        "Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],Sensor frame duration[nanosec],"
        "Frame readout time[nanosec],ISO,Focal length,Focus distance,AF mode,Unix time[nanosec]",
        "{t},980.4,981.5,205,10000000,33333333,20733000,144,3.95,0.16,3,1663406447943000000",
    ),
    "OIS fork": (
        "Timestamp[nanosec], fx[px], fy[px], Frame No., Exposure time[nanosec], Sensor frame duration[nanosec], "
        "Frame readout time[nanosec], ISO, Focal length, Focus distance, OIS",
        "{t},980.4,981.5,205,10000000,33333333,20733000,144,3.95,0.16,0",
    ),
}


@pytest.mark.parametrize("variant", METADATA_HEADERS)
def test_metadata_reads_every_variant(tmp_path, variant):
    """Exposure, readout and other columns are found by name in each layout; missing columns are NaN."""
    header, row = METADATA_HEADERS[variant]
    table = read_movie_metadata(put(tmp_path, f"{header}\n{row.format(t=T)}\n{header}\n{row.format(t=T + 1)}\n"))
    assert table.time_ns.tolist() == [T, T + 1]
    np.testing.assert_allclose([table.exposure_s[0], table.readout_time_s[0], table.iso[0]], [0.01, 0.020733, 144])
    assert table.focal_length_mm[0] == 3.95
    assert np.isnan(table.fx_px[0]) == ("fx" not in header)
    assert table.dropped == {"header repeated": 1}
    assert (table.unix_ns is None) == (variant != "unix")
    if table.unix_ns is not None:
        assert table.unix_ns.tolist() == [1663406447943000000] * 2


def test_metadata_null_and_placeholders_are_unknown(tmp_path):
    """The logger writes ``null``, fx 1.0 or a readout time of 0 for unknown values."""
    header = METADATA_HEADERS["v1"][0]
    table = read_movie_metadata(put(tmp_path, f"{header}\n{T},1.0,1.0,1,null,null,0,null,null,null,null\n"))
    for column in (table.fx_px, table.fy_px, table.exposure_s, table.readout_time_s, table.iso):
        assert np.isnan(column).all()


@pytest.mark.parametrize(
    ("text", "unix"),
    [
        (f"Frame timestamp[nanosec]\n{T}\n{T + 33_400_000}\n{T + 66_800_000}\n", False),
        (f"Frame timestamp[nanosec],Unix time[nanosec]\n{T},7\n{T + 33_400_000},8\n{T + 66_800_000},9\n", True),
        (f"{T // 1000}\n{T // 1000 + 33_400}\n{T // 1000 + 66_800}\n", False),
        (f"{T}\n{T + 33_400_000}\n{T + 66_800_000}\n", False),
    ],
    ids=["1 column", "2 columns", "microseconds without header", "nanoseconds without header"],
)
def test_timestamps_read_every_variant(tmp_path, text, unix):
    """Timestamps are in ns for every header and without one."""
    table = read_frame_timestamps(put(tmp_path, text))
    np.testing.assert_array_equal(np.diff(table.time_ns), 33_400_000)
    assert table.time_ns[0] // 1_000_000 == T // 1_000_000
    assert (table.unix_ns is not None) == unix


def test_a_truncated_last_timestamp_is_dropped(tmp_path):
    """A truncated number is smaller than its predecessors."""
    table = read_frame_timestamps(put(tmp_path, f"Frame timestamp[nanosec]\n{T}\n{T + 1}\n{str(T + 2)[:6]}"))
    assert table.time_ns.tolist() == [T, T + 1]
    assert table.dropped == {"time falls or leaps": 1}


def test_a_cut_last_number_is_unknown(tmp_path):
    """An exposure of which half was copied still parses; the numbers before it are whole."""
    header = METADATA_HEADERS["v1"][0]
    row = "980.4,981.5,205,10000000,33333333,20733000,144,3.95,0.16,3"
    table = read_movie_metadata(put(tmp_path, f"{header}\n{T},{row}\n{T + 1},{row[:19]}"))
    assert table.exposure_s.tolist() == pytest.approx([0.01, math.nan], nan_ok=True)
    assert table.fx_px.tolist() == [980.4, 980.4]
    whole = read_movie_metadata(put(tmp_path, f"{header}\n{T},{row}\n{T + 1},{row}"))
    assert whole.exposure_s.tolist() == [0.01, 0.01]


@pytest.mark.parametrize("rows_too", [False, True])
def test_quoted_fields_are_read(tmp_path, rows_too):
    """R quotes the header, other writers every field."""

    def quoted(row: str) -> str:
        return ",".join(f'"{field}"' for field in row.split(","))

    rows = [f"{T + k},0.1,-0.2,8.2E-4,1.0,9.8,-0.5" for k in range(3)]
    text = "\n".join([quoted(GYRO_TIGHT), *(map(quoted, rows) if rows_too else rows)]) + "\n"
    table = read_gyro_accel(put(tmp_path, text))
    assert table.time_ns.tolist() == [T, T + 1, T + 2]
    assert table.gyro_rad_s[0].tolist() == [0.1, -0.2, 8.2e-4]
    assert table.dropped == {}


def test_edge_epochs_with_repeated_block(tmp_path):
    """The source and the mean of all difference rows are read, including appended blocks."""
    block = (
        "#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_TIMESTAMP_SOURCE is "
        "SENSOR_INFO_TIMESTAMP_SOURCE_UNKNOWN (0).\n#elapsedRealtimeNanos()\tnanoTime()\tDifference\n"
    )
    text = f"{block}300\t100\t200\n400\t196\t204\n{block}500\t298\t202\nhalf a li"
    epochs = read_edge_epochs(put(tmp_path, text))
    assert (epochs.source, epochs.mean_difference_ns) == ("UNKNOWN", 202)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "is empty"),
        ("\n\n", "is empty"),
        ("userId,movieId,rating\n1,2,3\n", "not a header of gyro_accel.csv"),
        (METADATA_HEADERS["v1"][0] + "\n", "movie_metadata.csv, not of gyro_accel.csv.*swapped"),
        ("Frame timestamp[nanosec]\n1\n", "frame_timestamps.txt"),
        (GYRO_TIGHT + "\n", "0 usable of 0 rows"),
        ("\x00\x00\x00", "NUL"),
        (GYRO_TIGHT.replace("nanosec", "sec") + "\n1.5,1,1,1,1,1,1\n", "seconds"),
    ],
)
def test_foreign_gyro_files_are_named(tmp_path, text, match):
    """The error for each kind of wrong content states what the file contains."""
    with pytest.raises(ImuError, match=match):
        read_gyro_accel(put(tmp_path, text))


def test_undecodable_bytes_are_dropped(tmp_path):
    """Rows of undecodable bytes are counted."""
    path = tmp_path / "gyro_accel.csv"
    path.write_bytes(GYRO_TIGHT.encode() + b"\n1,1,1,1,1,1,1\n\xff\xfe\x80,2\n3,1,1,1,1,1,1\n")
    table = read_gyro_accel(path)
    assert table.time_ns.tolist() == [1, 3]
    assert table.dropped == {"cut or unreadable row": 1}


def test_a_very_long_line_is_refused(tmp_path):
    """The scan rejects a line of several megabytes before the table is read."""
    path = tmp_path / "gyro_accel.csv"
    path.write_bytes(GYRO_TIGHT.encode() + b"\n" + b"1" * (3 << 20))
    with pytest.raises(ImuError, match="a line has more than"):
        read_gyro_accel(path)


@pytest.mark.parametrize("shift", [0, 1, 65_535, 65_536, 65_537, 1 << 20])
def test_a_long_line_is_found_at_any_position(tmp_path, shift):
    """Borders between the scan's chunks neither hide a long line nor create one."""
    short = b"x" * 99 + b"\n"
    body = short * (shift // 100) + b"y" * (shift % 100) + b"\n"
    path = tmp_path / "t.txt"
    path.write_bytes(body + short * 30_000)
    assert files.scan_text(path).lines == body.count(b"\n") + 30_000
    path.write_bytes(body + b"z" * (files.MAX_LINE_BYTES + 1) + b"\n" + short * 20_000)
    with pytest.raises(CaptureError, match="a line has more"):
        files.scan_text(path)


@given(st.lists(st.integers(1, 60), min_size=1, max_size=40))
def test_strictly_rising_keeps_a_rising_subset(values):
    """The kept times rise strictly, and every row is either kept or counted."""
    times = np.array(values)
    keep, lost = strictly_rising(times)
    assert (np.diff(times[keep]) > 0).all()
    assert keep.sum() + sum(lost.values()) == len(times)


def test_a_single_leap_drops_one_row():
    """Only the row with a time far ahead is dropped, not the rows after it."""
    keep, lost = strictly_rising(np.array([1, 2, 3000, 4, 5, 6]))
    assert keep.tolist() == [True, True, False, True, True, True]
    assert lost == {"time falls or leaps": 1}


def test_times_that_mostly_fall_are_refused(tmp_path):
    """A table with falling times is an error."""
    rows = "".join(f"{100 - i},1,1,1,1,1,1\n" for i in range(20))
    with pytest.raises(ClockError, match="of 20 times rise") as caught:
        read_gyro_accel(put(tmp_path, GYRO_TIGHT + "\n" + rows))
    assert "out of order" in caught.value.hint
    rows = "".join(f"{100 + i // 4},{i},1,1,1,1,1\n" for i in range(20))
    with pytest.raises(ClockError, match="5 of 20 times rise") as caught:
        read_gyro_accel(put(tmp_path, GYRO_TIGHT + "\n" + rows))
    assert "spreadsheet" in caught.value.hint


def test_old_real_text_files(realdata):
    """The published text samples of the first release are read completely."""
    place = realdata / "mars_text_v1"
    assert len(read_gyro_accel(place / "test_data/mars_gyro_accel.csv").time_ns) == 226
    assert len(read_frame_timestamps(place / "test_data/mars_frame_timestamps.txt").time_ns) == 1812
    metadata = read_movie_metadata(place / "python_test_data/movie_metadata.csv")
    assert metadata.iso[0] == 1800
    np.testing.assert_allclose(metadata.readout_time_s, 0.020733)
