"""Coverage-guided fuzzing of the readers, outside the test suite; needs `pip install atheris`.

$ PYTHONPATH=. python tests/fuzz_readers.py FINDINGS [movie|text] [libFuzzer's options, such as -max_total_time=600]

Each input is written to a file and read.  A `VirestError` of one line is a valid answer; anything else is a finding.
The folder FINDINGS keeps each finding with its input, once for each place in the code.  libFuzzer itself stops at a
hang or at excessive memory.
"""

import logging
import os
import random
import struct
import sys
import tempfile
import traceback
import warnings
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

import atheris
import numpy as np

with atheris.instrument_imports(include=["virest"]):
    from virest.app import settings
    from virest.app.run_folder import RunFolder, find_run, finished_segments
    from virest.camera.kalibr import parse_imu
    from virest.camera.yaml_mapping import load_yaml_mapping
    from virest.capture.euroc import parse_sensor, read_exposure_times, read_imu_rows
    from virest.capture.gyroflow import read_header, read_log
    from virest.capture.marslogger_android import (
        read_edge_epochs,
        read_frame_timestamps,
        read_gyro_accel,
        read_movie_metadata,
    )
    from virest.capture.pictures import read_picture_list
    from virest.capture.profile_source import read_any_profile
    from virest.capture.stills import read_exposures
    from virest.capture.video import MovieIndex, probe_movie, read_gray
    from virest.errors import VirestError

FOLDER = Path(tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
FOUND: dict[str, int] = {}
FIELDS = (0, 1, 2, 0x10000, 1 << 28, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
MOVIE = MovieIndex(64, 48, Fraction(1, 1000), np.arange(3), (0,), (0,))
settings.settings_model = lru_cache(settings.settings_model)  # the form is the same for each input


def read_movie(path: Path) -> None:
    """Index a movie and decode a few of its frames."""
    index = probe_movie(path)
    for _ in read_gray(path, index, range(3)):
        pass


def mutate_movie(data: bytes, max_size: int, seed: int) -> bytes:
    """Change numbers in the movie's tables, which are few of its bytes; every fourth time change anything."""
    start = data.find(b"moov")
    if start < 0 or len(data) - start < 16 or seed % 4 == 0:
        return bytes(atheris.Mutate(data, max_size))
    rng, changed = random.Random(seed), bytearray(data)
    for _ in range(rng.randint(1, 3)):
        place = rng.randrange(start, len(data) - 4)
        number = struct.unpack_from(">I", data, place)[0] + rng.choice((-1, 1, 1 << rng.randrange(32)))
        struct.pack_into(">I", changed, place, rng.choice((number & 0xFFFFFFFF, *FIELDS)))
    return bytes(changed)


def read_gyroflow_log(path: Path) -> None:
    """Read header and samples of a .gcsv."""
    read_log(path, read_header(path))


def read_sensor(path: Path) -> None:
    """Read EuRoC's description of a camera; errors of its YAML are settings errors."""
    parse_sensor(load_yaml_mapping(path), np.eye(4), path.name, MOVIE, [])


def read_run(path: Path) -> None:
    """Inspect a run folder whose state is the input."""
    run = RunFolder(FOLDER / "run")
    run.frames.mkdir(parents=True, exist_ok=True)
    run.segments.mkdir(exist_ok=True)
    data = path.read_bytes()
    run.state.write_bytes(data)
    run.segment_log(0, 1).write_bytes(data)
    find_run(run)
    finished_segments(run, [(0, 1)])


TEXT: list[tuple[str, Any]] = [
    ("gyro_accel.csv", read_gyro_accel),
    ("movie_metadata.csv", read_movie_metadata),
    ("frame_timestamps.txt", read_frame_timestamps),
    ("edge_epochs.txt", read_edge_epochs),
    ("imu.csv", read_imu_rows),
    ("data.csv", read_picture_list),
    ("camera.yaml", read_any_profile),
    ("settings.yaml", settings.read_settings),
    ("run.json", read_run),
    ("log.gcsv", read_gyroflow_log),
    ("exposures.csv", lambda path: read_exposures(path, ["a.png", "b.png"])),
    ("times.txt", read_exposure_times),
    ("sensor.yaml", read_sensor),
    ("imu.yaml", lambda path: parse_imu(load_yaml_mapping(path))),
]


def keep_finding(findings: Path, name: str, data: bytes) -> None:
    """Keep the input, once for each place in the code."""
    kind, value, trace = sys.exc_info()
    place = [f for f in traceback.extract_tb(trace) if "/virest/" in f.filename][-1]
    key = f"{name}-{kind.__name__ if kind else ''}-{Path(place.filename).stem}-{place.name}"
    FOUND[key] = FOUND.get(key, 0) + 1
    if FOUND[key] == 1:
        (findings / key).write_bytes(data)
        print(f"FOUND {key}: {str(value)[:200]}", flush=True)


def main() -> None:
    """Run libFuzzer over the movie reader, or over all other readers."""
    findings, what, options = Path(sys.argv[1]), sys.argv[2], sys.argv[3:]
    findings.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)  # a warning for each damaged movie would fill the disk

    def test_one(data: bytes) -> None:
        if what == "movie":
            name, reader, content = "movie.mp4", read_movie, data
        elif data:
            name, reader = TEXT[data[0] % len(TEXT)]
            content = data[1:]
        else:
            return
        path = FOLDER / name
        path.write_bytes(content)
        try:
            reader(path)
        except VirestError as error:
            if len(str(error).splitlines()) != 1 or len(str(error)) > 2000:
                keep_finding(findings, name, data)
        except (Exception, RecursionError):
            keep_finding(findings, name, data)

    atheris.Setup([sys.argv[0], *options], test_one, **({"custom_mutator": mutate_movie} if what == "movie" else {}))
    atheris.Fuzz()


if __name__ == "__main__":
    main()
