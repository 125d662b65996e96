"""The three image sequences of one capture in EuRoC's layout, and the trajectories that a SLAM tool estimates.

``global``: the sharp global-shutter images of truth/frames; ``rolling``: the movie's frames as recorded;
``restored``: the frames restored by ``virest process``.  All have the same timestamps.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.app.jobs import Workers
from virest.app.process import ProcessOptions, process_capture
from virest.app.run_folder import read_lines
from virest.arrays import Array
from virest.camera.intrinsics import Intrinsics
from virest.camera.orb_slam import format_orb_slam
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import read_profile
from virest.capture.euroc import format_picture_list
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.pixels import luma_of
from virest.capture.records import Capture
from virest.capture.video import probe_movie, read_frames
from virest.errors import CaptureError, SettingsError
from virest.evaluation.structure_from_motion import find_path, match_pictures
from virest.evaluation.trajectories import CameraPath, match_times, parse_tum, tum_text
from virest.image_formation.row_motion import frame_times_s
from virest.restoration.capture import at_true_times
from virest.restoration.settings import RestorationSettings
from virest.simulation.recording import truth_picture

KINDS = ("global", "rolling", "restored")
PLACEHOLDERS = ("sequence", "trajectory", "settings", "times", "seed")
LEAST_FRAMES = 10
"""Fewer poses hardly constrain an alignment of seven parameters."""
_PLACE = re.compile(r"\{(\w+)\}")
_START = "first_row_start_s"
_MIDDLE = "middle_s"


@dataclass(frozen=True, slots=True)
class SlamSequences:
    """A capture's frames, ready to be tracked."""

    name: str
    folder: Path
    """Holds a folder of each kind."""
    kinds: tuple[str, ...]
    """The available KINDS; a capture without truth images has no ``global``."""
    lens: Intrinsics
    fps: float
    stamps_ns: tuple[int, ...]
    """Stamp of each frame: the names of the pictures."""
    start_s: Array
    """(frames,) start of the first row's exposure, on the true trajectory's clock."""
    middle_s: Array
    """(frames,) that + readout/2 + exposure/2."""
    truth: CameraPath

    def pictures(self, kind: str) -> Path:
        """Folder of one kind's images."""
        return self.folder / kind / "mav0" / "cam0" / "data"


# ── making them ────────────────────────────────────────────────────────────────────────────────────────────────────


def write_sequences(capture_path: Path, out: Path, settings: RestorationSettings) -> SlamSequences:
    """Process a capture, and write the restored frames with their recorded and truth versions.

    Raises CaptureError if there is no truth, or too few frames.
    """
    truth = read_true_path(capture_path / "truth" / "trajectory.csv")
    capture = read_capture(capture_path)
    profile = resolve_profile(capture)[0]
    if (lens := profile.intrinsics) is None:
        raise CaptureError(f"{capture.name}: no focal length is known", hint="set fx_px in camera.yaml")
    options = ProcessOptions(out / "run", settings, command="virest evaluate slam", mode="new")
    workers = Workers(1)
    try:
        run = process_capture(str(capture_path), capture.name, options, workers).folder
    finally:
        workers.kill()
    restored = {line["frame"]: run / line["output"] for line in read_lines(run / "parameters.jsonl") if line["output"]}
    sharp = {k: file for k in restored if (file := truth_picture(capture_path, k)).is_file()}
    kinds = KINDS if sharp else KINDS[1:]
    numbers = sorted(sharp or restored)
    if len(numbers) < LEAST_FRAMES:
        raise CaptureError(
            f"{capture.name}: only {len(numbers)} usable frames; {LEAST_FRAMES} are needed",
            hint="use a longer capture",
        )
    stamps = {k: capture.frames[k].timestamp_ns for k in numbers}
    for kind in kinds:
        _write_euroc(out / kind, _pictures(kind, numbers, capture, restored, sharp), stamps)
    times = _frame_times(capture, capture_path / "truth")
    start, middle = (np.array([times[k][i] for k in numbers]) for i in (0, 1))
    fps = 1e9 * (len(numbers) - 1) / (stamps[numbers[-1]] - stamps[numbers[0]])
    made = SlamSequences(capture.name, out, kinds, lens, fps, tuple(stamps.values()), start, middle, truth)
    (out / "orb_slam.yaml").write_text(orb_slam_settings(profile, fps), encoding="utf-8")
    true = truth.at(start)
    (out / "truth.tum").write_text(tum_text(CameraPath(_seconds(made), true.position_m, true.q_world_cam)), "utf-8")
    return made


def read_true_path(file: Path) -> CameraPath:
    """Read truth/trajectory.csv: time_s, position in metres, orientation w x y z, in the world."""
    if not file.is_file():
        raise CaptureError(
            f"{file}: no such file; the true trajectory is needed for scoring",
            hint="give a capture written by `virest simulate`, or none",
        )
    try:
        table = np.loadtxt(file, delimiter=",", skiprows=1, ndmin=2)
    except ValueError as error:
        raise CaptureError(f"{file}: {error}", hint="expected columns: time_s,px_m,py_m,pz_m,qw,qx,qy,qz") from error
    if table.shape[1] != 8 or len(table) < 2 or (np.diff(table[:, 0]) <= 0).any():
        raise CaptureError(f"{file}: is not a trajectory", hint="time_s,px_m,py_m,pz_m,qw,qx,qy,qz, times rising")
    return CameraPath(table[:, 0], table[:, 1:4], table[:, 4:])


def _frame_times(capture: Capture, truth: Path) -> dict[int, tuple[float, float]]:
    """True capture time of each frame: from truth/effects.json, else by the profile (the true one if given)."""
    effects = truth / "effects.json"
    if effects.is_file():
        slots = json.loads(effects.read_text(encoding="utf-8"))["slots"]
        return {slot["frame"]: (slot[_START], slot[_MIDDLE]) for slot in slots}
    given = truth / "camera.yaml"
    profile = read_profile(given) if given.is_file() else resolve_profile(capture)[0]
    found = {}
    for frame in at_true_times(capture.frames, profile, capture.repeats):
        found[frame.index] = frame_times_s(profile, frame.time_s, frame.exposure_s, "frame-middle")
    return found


def _pictures(
    kind: str, numbers: list[int], capture: Capture, restored: dict[int, Path], sharp: dict[int, Path]
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Grey pictures of one kind, by frame number."""
    if kind != "rolling":
        for number in numbers:
            picture = cv2.imread(str((sharp if kind == "global" else restored)[number]), cv2.IMREAD_GRAYSCALE)
            if picture is None:
                raise CaptureError(f"{capture.name}: the {kind} picture of frame {number} cannot be read")
            yield number, np.asarray(picture, np.uint8)
        return
    wanted = set(numbers)
    for number, decoded in read_frames(capture.movie, probe_movie(capture.movie), numbers[0], numbers[-1]):
        if number in wanted and decoded is not None:
            yield number, luma_of(decoded)


def _write_euroc(folder: Path, pictures: Iterator[tuple[int, NDArray[np.uint8]]], stamps_ns: dict[int, int]) -> None:
    """Write mav0/cam0/data/<ns>.png, its data.csv, and times.txt with one stamp a line."""
    data = folder / "mav0" / "cam0" / "data"
    data.mkdir(parents=True)
    written = []
    for number, picture in pictures:
        cv2.imwrite(str(data / f"{stamps_ns[number]}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        written.append(stamps_ns[number])
    (data.parent / "data.csv").write_text(format_picture_list(written), encoding="ascii")
    (folder / "times.txt").write_text("".join(f"{stamp}\n" for stamp in written), encoding="ascii")


def _seconds(sequences: SlamSequences) -> Array:
    """Timestamps in seconds from the first frame."""
    return np.array([(stamp - sequences.stamps_ns[0]) * 1e-9 for stamp in sequences.stamps_ns])


def orb_slam_settings(profile: CameraProfile, fps: float) -> str:
    """Settings for ORB-SLAM3 without IMU, with the Camera entries of ORB-SLAM2 in addition to Camera1."""
    text = format_orb_slam(profile, fps, None, ["frames only"], "evaluate slam")
    older = [line.replace("Camera1.", "Camera.") for line in text.splitlines() if line.startswith("Camera1.")]
    return text + "\n".join(older) + "\n"


# ── tracking them ──────────────────────────────────────────────────────────────────────────────────────────────────


def track_with_colmap(sequences: SlamSequences, kind: str, seeds: list[int]) -> Iterator[dict[int, Array]]:
    """Positions by frame (0 … frames − 1) from structure from motion, for each seed."""
    work = sequences.folder / f"{kind}-colmap"
    work.mkdir()
    try:
        database = match_pictures(sequences.pictures(kind), work, sequences.lens)
        place = {f"{stamp}.png": k for k, stamp in enumerate(sequences.stamps_ns)}
        for seed in seeds:
            found = find_path(database, work, seed)
            frames = [place[name] for name in found.pictures]
            stamps_s = _seconds(sequences)[frames]
            text = tum_text(CameraPath(stamps_s, found.position, found.q_world_cam))
            (sequences.folder / f"{kind}-{seed}.tum").write_text(text, encoding="ascii")
            yield dict(zip(frames, found.position, strict=True))
    finally:
        shutil.rmtree(work, ignore_errors=True)


def track_with_command(
    sequences: SlamSequences, kind: str, seeds: list[int], command: list[str], timeout_s: float
) -> Iterator[dict[int, Array]]:
    """Positions by frame in the trajectories that a program writes, one run per seed; empty for a failed run.

    Lost tracking is a result and scores as lost; a program that cannot be started is an error.
    """
    folder = (sequences.folder / kind).resolve()
    for seed in seeds:
        trajectory = sequences.folder.resolve() / f"{kind}-{seed}.tum"
        places = {
            "sequence": str(folder),
            "trajectory": str(trajectory),
            "settings": str((sequences.folder / "orb_slam.yaml").resolve()),
            "times": str(folder / "times.txt"),
            "seed": str(seed),
        }
        run_command(fill_command(command, places), sequences.folder / f"{kind}-{seed}.log", timeout_s)
        yield _read_positions(trajectory, sequences)


def split_command(text: str) -> list[str]:
    """Split a command line into arguments without a shell, and check its placeholders."""
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise SettingsError(f"--command {text!r}: {error}", hint="quote arguments as in a shell") from None
    used = {name for word in words for name in _PLACE.findall(word)}
    unknown, missing = used - set(PLACEHOLDERS), {"sequence", "trajectory"} - used
    if unknown or missing:
        wrong = f"has an unknown {{{min(unknown)}}}" if unknown else f"has no {{{min(missing)}}}"
        known = ", ".join(f"{{{name}}}" for name in PLACEHOLDERS)
        raise SettingsError(f"--command {wrong}", hint=f"placeholders: {known}; the first two are required")
    return words


def fill_command(words: list[str], places: dict[str, str]) -> list[str]:
    """Fill in the placeholders of each argument; a value never splits an argument."""
    return [_PLACE.sub(lambda found: places[found[1]], word) for word in words]


def run_command(words: list[str], log_file: Path, timeout_s: float) -> bool:
    """Run a program without a shell, its output in a file; returns whether it exited with 0 in time.

    Raises SettingsError if it cannot be started.
    """
    with log_file.open("wb") as log:
        try:
            done = subprocess.run(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                timeout=timeout_s,
                check=False,
                cwd=log_file.parent,
            )
        except subprocess.TimeoutExpired:
            log.write(f"\nvirest: stopped after {timeout_s:g} s\n".encode())
            return False
        except OSError as error:
            raise SettingsError(
                f"--command: {words[0]}: {error.strerror or error}", hint="give the program's full path"
            ) from error
    return done.returncode == 0


def _read_positions(trajectory: Path, sequences: SlamSequences) -> dict[int, Array]:
    """Positions by frame.  Tools write s or ns, absolute or from the first frame: the unit that fits most counts."""
    if not trajectory.is_file():
        return {}
    found = parse_tum(trajectory.read_text(encoding="utf-8", errors="replace"))
    stamps_s = _seconds(sequences)
    readings = []
    for unit_s in (1.0, 1e-9):
        for first_s in (sequences.stamps_ns[0] * 1e-9, 0.0):
            read = replace(found, time_s=found.time_s * unit_s - first_s)
            readings.append(match_times(stamps_s, read, 0.25 / sequences.fps))
    return max(readings, key=len)
