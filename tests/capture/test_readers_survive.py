"""Whatever a file contains, a reader returns a result or a one-line error."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from capture_writing import GYRO_7, METADATA_11, PERIOD_NS, moving_pictures, write_movie
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from virest.app.run_folder import RunFolder, find_run, finished_segments
from virest.app.settings import read_settings
from virest.capture.euroc import read_imu_rows
from virest.capture.marslogger_android import (
    read_edge_epochs,
    read_frame_timestamps,
    read_gyro_accel,
    read_movie_metadata,
)
from virest.capture.pictures import read_picture_list
from virest.capture.profile_source import read_any_profile
from virest.capture.video import probe_movie, read_gray
from virest.errors import VirestError

SHORT = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
FIELDS = st.one_of(
    st.integers(-(2**70), 2**70).map(str),
    st.floats().map(repr),
    st.sampled_from(
        ["", " ", "null", "NaN", "-inf", "1e400", "0x10", '"', "'", "\t", "\r", "#", "\\", "1,5", "１２", "²"]
    ),
    st.text(max_size=8),
)
STAMPS = st.integers(0, 10**6).map(lambda i: str(28_670_339_410_000 + i * 1000))
ROWS = st.lists(st.one_of(st.lists(FIELDS, max_size=14), st.tuples(STAMPS).map(list)).map(",".join), max_size=12)
FULL_ROWS = st.lists(
    st.lists(FIELDS, min_size=6, max_size=11).flatmap(lambda row: STAMPS.map(lambda t: ",".join([t, *row])))
)
HEADERS = {
    "gyro_accel.csv": (GYRO_7, read_gyro_accel),
    "movie_metadata.csv": (METADATA_11, read_movie_metadata),
    "frame_timestamps.txt": ("Frame timestamp[nanosec],Unix time[nanosec]", read_frame_timestamps),
    "edge_epochs.txt": ("#Camera frame timestamp source", read_edge_epochs),
    "imu.csv": ("#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z", read_imu_rows),
    "data.csv": ("#timestamp [ns],filename", read_picture_list),
}
KEYS = st.sampled_from([
    "virest_profile", "image", "width", "height", "intrinsics", "fx_px", "distortion", "model", "shutter", "imu",
    "T_cam_imu", "readout_time_s", "response", "kind", "gamma", "estimates", "extensions", "cam0", "camera_model",
    "deblur", "tile_px", "strength", "preset", "virest_settings",
])  # fmt: skip
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just("radtan")),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(KEYS, inner, max_size=4)),
    max_leaves=12,
)


def answers(reader: Callable[[Path], Any], name: str, data: bytes) -> None:
    """Read a file with these bytes; a one-line VirestError is accepted."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(data)
        try:
            reader(path)
        except VirestError as error:
            assert "\n" not in str(error)  # noqa: PT017


@pytest.mark.parametrize("name", HEADERS)
@SHORT
@given(rows=st.one_of(ROWS, FULL_ROWS), with_header=st.booleans(), end=st.sampled_from(["\n", "\r\n", "\r", ""]))
def test_tables_of_any_rows(name: str, rows: list[str], *, with_header: bool, end: str) -> None:
    """Overflowing numbers, quotes, digits of other scripts, and rows that are too short or too long."""
    header, reader = HEADERS[name]
    text = (end or "\n").join([header, *rows] if with_header else rows) + end
    answers(reader, name, text.encode("utf-8", "surrogatepass"))


@SHORT
@given(name=st.sampled_from(sorted(HEADERS)), data=st.binary(max_size=300))
def test_tables_of_any_bytes(name: str, data: bytes) -> None:
    """Bytes that are not text."""
    answers(HEADERS[name][1], name, data)


@SHORT
@given(content=st.dictionaries(KEYS, VALUES, max_size=6), cut=st.integers(0, 40))
def test_profiles_and_settings_of_any_values(content: dict[str, Any], cut: int) -> None:
    """Known keys with arbitrary values, complete and truncated."""
    import yaml

    data = yaml.safe_dump(content, allow_unicode=True).encode("utf-8", "surrogatepass")
    for reader in (read_any_profile, read_settings):
        answers(reader, "file.yaml", data)
        answers(reader, "file.yaml", data[:-cut] if cut else data)


@SHORT
@given(content=VALUES, tail=st.binary(max_size=10))
def test_run_state_files_of_any_json(content: Any, tail: bytes) -> None:
    """A run's request and logs written by another program."""
    import json

    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder(Path(folder) / "run")
        run.frames.mkdir(parents=True)
        run.segments.mkdir()
        data = json.dumps(content).encode() + tail
        run.segment_log(0, 1).write_bytes(data)
        assert finished_segments(run, [(0, 1)]) == set()
        answers(lambda path: find_run(RunFolder(path.parent)), "run.json", data)


@pytest.fixture(scope="module")
def small_movie(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A movie of four small frames."""
    path = tmp_path_factory.mktemp("movie") / "movie.mp4"
    write_movie(path, moving_pictures(4, width=32, height=32), [i * PERIOD_NS for i in range(4)])
    return path.read_bytes()


def read_movie(path: Path) -> None:
    """Index the movie and decode its first frames."""
    index = probe_movie(path)
    assert sum(1 for _ in read_gray(path, index, range(3))) == min(len(index), 3)


@SHORT
@given(
    edits=st.lists(st.tuples(st.integers(0, 4000), st.binary(min_size=1, max_size=8)), min_size=1, max_size=6),
    cut=st.one_of(st.just(0), st.integers(1, 3000)),
)
def test_movies_with_any_bytes_changed(small_movie: bytes, edits: list[tuple[int, bytes]], cut: int) -> None:
    """Boxes, tables and frames are overwritten, and the file is truncated."""
    data = bytearray(small_movie)
    for place, piece in edits:
        start = place % len(data)
        data[start : start + len(piece)] = piece
    answers(read_movie, "movie.mp4", bytes(data[:-cut] if cut else data))
