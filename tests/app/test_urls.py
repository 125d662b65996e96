"""Captures and outputs at URLs: an S3 server on localhost gives the same bytes as a disk."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from moto.server import ThreadedMotoServer
from run_content import folder_files, without_clocks

from virest.app import run_folder
from virest.app.outputs import capture_name, write_whole
from virest.app.run_folder import RunFolder, finished_segments, opened_run
from virest.capture import location
from virest.capture.folder import read_capture
from virest.capture.location import is_remote, is_unreachable, locate, read_each, remove_files
from virest.capture.video import probe_movie, read_gray
from virest.errors import OutputError, SettingsError, VideoError

Virest = Callable[..., "subprocess.CompletedProcess[str]"]
FAST = ("--preset", "fast", "--jobs", 1)
ELSEWHERE = ("folder", "movie", "profile_source", "source")
"""Keys of run.json that name a location."""
REQUEST = {"version": "1", "settings": {}, "frames": "0:1:1", "profile_sha256": "ab", "inputs": []}


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Address of an S3 server."""
    store = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    store.start()
    host, port = store.get_host_and_port()
    yield f"http://{host}:{port}"
    store.stop()


@pytest.fixture
def bucket(server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Address of an empty bucket, for this process and its child processes."""
    settings = {
        "AWS_ENDPOINT_URL": server, "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b",
        "AWS_DEFAULT_REGION": "us-east-1",
    }  # fmt: skip
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    location._file_system.cache_clear()
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    store = fsspec.filesystem("s3", use_listings_cache=False)
    store.mkdir("trips")
    yield "s3://trips"
    store.rm("trips", recursive=True)
    location._file_system.cache_clear()


def upload(folder: Path, address: str) -> None:
    """Copy a folder's files into the bucket."""
    for file in folder.rglob("*"):
        if file.is_file():
            (locate(address) / file.relative_to(folder).as_posix()).write_whole(file.read_bytes())  # type: ignore[attr-defined]


def everything(address: str) -> dict[str, bytes]:
    """All files below an address."""
    store = fsspec.filesystem("s3", use_listings_cache=False)
    key = address.removeprefix("s3://")
    return {name.removeprefix(key + "/"): store.cat_file(name) for name in store.find(key)}


def fail_after_a_segment(run: RunFolder) -> None:
    """Write one frame and its segment's log, then fail."""
    write_whole(run.picture(0), b"png")
    write_whole(run.segment_log(0, 0), b'{"frame": 0, "output": "frames/000000.png"}\n')
    raise RuntimeError


# ── addresses ────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_local_path_stays_a_plain_path(tmp_path: Path) -> None:
    """Local files are read as before; file:// is local."""
    for text in ("trip", "/data/a:b", "s3:/odd", str(tmp_path), f"file://{tmp_path}"):
        assert type(locate(text)) is type(Path())
    assert locate(f"file://{tmp_path}/a") == tmp_path / "a"


def test_an_address_has_the_parts_of_a_path() -> None:
    """Name, parent and sibling work as for a path."""
    place: Any = locate("S3://trips//2022/one/movie.mp4")
    assert is_remote(place)
    assert str(place) == "s3://trips/2022/one/movie.mp4"
    assert (place.name, place.stem, place.suffix) == ("movie.mp4", "movie", ".mp4")
    assert str(place.parent / "gyro_accel.csv") == "s3://trips/2022/one/gyro_accel.csv"
    assert str(place.with_name("x")) == "s3://trips/2022/one/x"
    assert capture_name("s3://trips/2022/one/") == "one"


@pytest.mark.parametrize("text", ["s3://", "s3:///", "s3://trips/../other", "nosuch://a/b"])
def test_an_invalid_address_is_refused(text: str) -> None:
    """The error has a hint."""
    with pytest.raises(SettingsError) as caught:
        locate(text)
    assert caught.value.hint


def test_a_missing_extra_gives_one_line(tmp_path: Path) -> None:
    """Without s3fs, the error for an s3:// address names the extra to install."""
    program = "import sys; sys.modules['s3fs'] = None; from virest.app.cli import run; sys.exit(run(sys.argv[1:]))"
    for arguments in (["s3://trips/one"], [str(tmp_path), "--out", "s3://trips/out"]):
        command = [sys.executable, "-c", program, "process", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (3, "")
        assert len(done.stderr.splitlines()) == 1
        assert "virest[cluster]" in done.stderr


# ── reading and writing ──────────────────────────────────────────────────────────────────────────────────────────


def test_a_capture_is_read_the_same_from_a_bucket(bucket: str, tiny: Path) -> None:
    """Frames, samples, notes, index and pictures are the same."""
    upload(tiny, f"{bucket}/tiny")
    here, there = read_capture(tiny), read_capture(locate(f"{bucket}/tiny"))
    assert there.frames == here.frames
    assert there.notes == here.notes
    assert there.counts == here.counts
    assert (there.imu.gyro_rad_s == here.imu.gyro_rad_s).all()
    assert there.keyframes == here.keyframes
    index = probe_movie(here.movie)
    assert (probe_movie(there.movie).pts_ticks == index.pts_ticks).all()
    for (i, one), (j, other) in zip(
        read_gray(here.movie, index, (3, 20)), read_gray(there.movie, index, (3, 20)), strict=True
    ):
        assert i == j
        assert (one == other).all()


def test_a_segment_requests_only_its_part_of_the_movie(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It requests the movie's index and the bytes of its frames, less than half of the file."""
    bytes_asked: list[int] = []
    honest = location._Stream.readinto
    movie = Path(tmp_path / "movie.mp4")
    write_long_movie(movie)
    index = probe_movie(movie)
    locate(f"{bucket}/movie.mp4").write_whole(movie.read_bytes())  # type: ignore[attr-defined]

    def counted(stream: Any, buffer: Any) -> int:
        bytes_asked.append(honest(stream, buffer))
        return bytes_asked[-1]

    monkeypatch.setattr(location._Stream, "readinto", counted)
    assert len(list(read_gray(locate(f"{bucket}/movie.mp4"), index, range(60, 66)))) == 6
    assert sum(bytes_asked) < movie.stat().st_size / 2


def write_long_movie(path: Path) -> None:
    """Write noise that does not compress, with a key frame every 8 frames."""
    import av
    import numpy as np

    rng = np.random.default_rng(3)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"g": "8", "crf": "10", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for _ in range(120):
            picture = rng.integers(0, 256, (120, 160, 3), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def test_an_unreachable_store_is_not_a_decoding_error(bucket: str, tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The movie may be intact: the error names the connection and is marked as unreachable."""
    index = probe_movie(tiny / "movie.mp4")
    upload(tiny, f"{bucket}/tiny")

    def broken(stream: Any, buffer: Any) -> int:
        raise OSError(5, "connection reset", "s3://trips/tiny/movie.mp4")

    monkeypatch.setattr(location._Stream, "readinto", broken)
    with pytest.raises(VideoError, match="connection reset") as caught:
        list(read_gray(locate(f"{bucket}/tiny/movie.mp4"), index, (1,)))
    assert is_unreachable(caught.value)
    assert not is_unreachable(VideoError("movie.mp4: is empty"))


def test_files_are_written_listed_fetched_and_removed(bucket: str) -> None:
    """A bucket behaves like a folder; a folder without files does not exist."""
    folder = locate(f"{bucket}/out")
    assert not folder.exists()
    assert list(folder.iterdir()) == []
    places = [folder / f"{i}.json" for i in range(70)]
    for i, place in enumerate(places):
        write_whole(place, str(i).encode())
    assert folder.is_dir()
    assert not folder.is_file()
    assert places[3].is_file()
    assert places[3].stat().st_size == 1
    assert sorted(p.name for p in folder.iterdir()) == sorted(p.name for p in places)
    assert list(read_each(places)) == [str(i).encode() for i in range(70)]
    assert list(read_each(places[:1])) == [b"0"]
    remove_files([*places, folder / "was never there"])
    assert not folder.exists()
    (folder / "nothing").unlink(missing_ok=True)


def test_a_missing_bucket_is_an_output_error(bucket: str) -> None:
    """The error names the address."""
    with pytest.raises(OutputError, match=r"s3://no-such-bucket/run\.json"):
        write_whole(locate("s3://no-such-bucket/run.json"), b"{}")


def test_a_run_has_the_same_states_in_a_bucket_as_in_a_folder(bucket: str) -> None:
    """Unfinished runs can be resumed, finished ones are refused, and foreign files stay."""
    run = RunFolder(locate(f"{bucket}/out/trip"))
    with pytest.raises(RuntimeError), opened_run(run, REQUEST, "new"):
        raise RuntimeError
    assert everything("s3://trips/out") == {}
    with pytest.raises(RuntimeError), opened_run(run, REQUEST, "new"):
        fail_after_a_segment(run)
    with pytest.raises(OutputError, match="unfinished"), opened_run(run, REQUEST, "new"):
        pass
    with opened_run(run, REQUEST, "resume") as found:
        assert found == "unfinished"
        assert finished_segments(run, [(0,), (1, 2)]) == {(0,)}
        run_folder.finish_run(run, [run.segment_log(0, 0)], REQUEST)
    names = {"frames/000000.png", "parameters.jsonl", "run.json"}
    assert set(everything("s3://trips/out/trip")) == names
    with pytest.raises(OutputError, match="finished"), opened_run(run, REQUEST, "new"):
        pass
    write_whole(run.path / "mine.txt", b"mine")
    with opened_run(run, REQUEST, "overwrite"):
        assert set(everything("s3://trips/out/trip")) == {"mine.txt", ".run"}


@pytest.mark.scenario
def test_a_run_from_bucket_to_bucket_equals_the_local_run(
    virest: Virest, bucket: str, tiny: Path, tmp_path: Path
) -> None:
    """The files are equal byte for byte, also after a kill and ``--resume``; ``--json`` prints the same lines."""
    upload(tiny, f"{bucket}/tiny")
    assert virest("process", tiny, "--out", tmp_path / "out", *FAST).returncode == 0
    local = without_clocks(folder_files(tmp_path / "out/tiny"), *ELSEWHERE)
    run = locate(f"{bucket}/out/tiny")
    command = [
        sys.executable,
        "-m",
        "virest",
        "process",
        f"{bucket}/tiny",
        "--out",
        f"{bucket}/out",
        "--preset",
        "fast",
    ]
    with subprocess.Popen([*command, "--jobs", "2"], stderr=subprocess.PIPE) as process:
        while process.poll() is None and not (run / ".segments").is_dir():
            time.sleep(0.05)
        process.kill()
        process.communicate()
    assert not (run / "run.json").exists()
    result = virest("process", f"{bucket}/tiny", "--out", f"{bucket}/out", *FAST, "--resume", "--json")
    assert result.returncode == 0, result.stderr
    files = everything(f"{bucket}/out/tiny")
    assert result.stdout.encode() == files["parameters.jsonl"]
    assert without_clocks(files, *ELSEWHERE) == local
    again = virest("process", f"{bucket}/tiny", "--out", f"{bucket}/out", *FAST)
    assert again.returncode == 8
    missing = virest("process", f"{bucket}/missing", "--out", f"{bucket}/out", *FAST)
    assert (missing.returncode, missing.stdout) == (4, "")
    assert "no such folder" in missing.stderr
