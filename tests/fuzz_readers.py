"""Coverage-guided fuzzing of the readers, beside the suite: needs `pip install atheris`.

$ PYTHONPATH=. python tests/fuzz_readers.py FINDINGS [movie|text] [libFuzzer's options, such as -max_total_time=600]

Each input is written to a file and read.  A `VirestError` is an answer; anything else is a finding: kept once for each
place in the code, with its input, in the folder FINDINGS.  libFuzzer itself ends at a hang or at too much memory.
"""

import os
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from typing import Any

import atheris

with atheris.instrument_imports(include=["virest"]):
    import yaml

    from virest.app.outputs import RunFolder, find_run, finished_segments, parse_lines
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

FOLDER = Path(tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
FOUND: dict[str, int] = {}


def read_movie(path: Path) -> None:
    """Index a movie, and decode a few of its frames."""
    index = probe_movie(path)
    for _ in read_gray(path, index, range(3)):
        pass


def read_run(path: Path) -> None:
    """Look at a run's folder whose state is the input."""
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
    ("settings.yaml", read_settings),
    ("run.json", read_run),
]


def keep_finding(findings: Path, name: str, data: bytes) -> None:
    """Keep the input, once for each place in the code."""
    kind, value, trace = sys.exc_info()
    place = [f for f in traceback.extract_tb(trace) if "/virest/" in f.filename][-1]
    key = f"{name}-{kind.__name__ if kind else ''}-{Path(place.filename).stem}-{place.lineno}"
    FOUND[key] = FOUND.get(key, 0) + 1
    if FOUND[key] == 1:
        (findings / key).write_bytes(data)
        print(f"FOUND {key}: {str(value)[:200]}", flush=True)


def main() -> None:
    """Run libFuzzer over the movie reader, or over all others."""
    findings, what, options = Path(sys.argv[1]), sys.argv[2], sys.argv[3:]
    findings.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")

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
            if "\n" in str(error) or len(str(error)) > 2000:
                print("LONG", name, repr(str(error))[:300], flush=True)
        except (Exception, RecursionError):
            keep_finding(findings, name, data)

    atheris.Setup([sys.argv[0], *options], test_one)
    atheris.Fuzz()


if __name__ == "__main__":
    _ = (yaml, parse_lines)
    main()
