"""``virest diagnose CAPTURE``: what the camera model gets wrong, why, what to add, and what that gains."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.diagnosis_text import describe
from virest.app.field_record import field_record
from virest.app.outputs import capture_name, json_text, output_error, plain, require_writable, write_whole
from virest.app.recreate import restored_scene
from virest.app.run_folder import DIAGNOSIS, EXTENDED, FIGURE, FIGURES
from virest.arrays import Picture
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import format_profile, profile_mapping
from virest.camera.yaml_mapping import commented
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.join import consecutive_runs
from virest.capture.records import Capture
from virest.capture.video import GrayReader, MovieIndex, probe_movie, read_frames
from virest.diagnosis.findings import CONSISTENT, Diagnosis, FieldFinding, Finding, Rung
from virest.diagnosis.restoration_gain import (
    RestorationGain,
    chosen_pairs,
    measure_restoration_gain,
    pairs_to_keep_back,
    restore_pairs,
)
from virest.errors import OutputError, VirestError
from virest.image_formation.row_clock import RowClock
from virest.inference.parallel import ParallelMap, begun, one_by_one
from virest.report.field_figures import field_figure
from virest.report.figures import comparison_figure, ladder_figure, residual_figure
from virest.report.words import SHOWN_COMPONENTS
from virest.restoration.capture import RestorationPlan
from virest.restoration.settings import PRESETS
from virest.simulation.recreation import recreate_session
from virest.simulation.session import SessionSettings, render_picture

log = logging.getLogger(__name__)

Json = dict[str, Any]
Progress = Callable[[str, float], None]
Reader = Callable[[Sequence[int]], Iterator[tuple[int, Picture | None]]]

SCHEMA = "virest/diagnosis/1"
NOT_CONSISTENT = 10
"""Exit code with ``--check`` (docs/exit-codes.md)."""
LADDER_PART, GAIN_PART = 0.85, 0.95
"""Progress, from 0 to 1, at which the ladder and the restorations end."""
MAX_RUNGS = 8
"""More panels side by side cannot be read."""


@dataclass(frozen=True, slots=True)
class DiagnosisOptions:
    """The options of one ``virest diagnose``."""

    out: Path
    config: Path | None = None
    overwrite: bool = False


@dataclass(frozen=True, slots=True)
class DiagnosisOutcome:
    """The result of one diagnosis."""

    facts: Json
    """The content of diagnosis.json."""
    text: str
    """The printed text."""
    verdict: str

    @property
    def check_code(self) -> int:
        """Exit code with ``--check``."""
        return 0 if self.verdict == CONSISTENT else NOT_CONSISTENT


@dataclass(frozen=True, slots=True)
class RgbReader:
    """Reads requested frames of a movie; picklable, so that each process decodes for itself."""

    movie: Path
    index: MovieIndex

    def __call__(self, numbers: Sequence[int]) -> Iterator[tuple[int, Picture | None]]:
        """Stream (movie index, RGB (h, w, 3) or None), ascending."""
        for first, last in consecutive_runs(numbers):
            yield from read_frames(self.movie, self.index, first, last)


@dataclass(frozen=True, slots=True)
class Source:
    """A capture with its profile, and readers of its frames."""

    capture: Capture
    profile: CameraProfile
    pictures: Reader
    gray: Reader


def run_diagnosis(
    path: str, options: DiagnosisOptions, progress: Progress | None = None, each: ParallelMap = one_by_one
) -> DiagnosisOutcome:
    """Diagnose one capture and write DIR/<capture>/diagnosis.json, extended.yaml and figures.

    progress: called with each stage and the finished fraction.  each: maps calls over processes.  Raises CaptureError,
    SettingsError, CalibrationError, OutputError; nothing is written then.
    """
    say = progress or (lambda _stage, _part: None)
    folder = Path(options.out) / capture_name(path)
    require_free(folder, options.overwrite)
    source = open_source(Path(path), options.config)
    found, gain = _diagnosed_with_gain(source, say, each)
    say("figures", GAIN_PART)
    files, drawn = draw_figures(source.capture, found, each)
    facts = as_json(found, gain, drawn)
    files[EXTENDED] = extended_text(source.capture.name, found).encode()
    files[DIAGNOSIS] = json_text(facts).encode()
    _write_all(folder, files)
    say("done", 1.0)
    text = describe(source.capture.name, found, gain, f"{folder / DIAGNOSIS}, {EXTENDED} and figures")
    return DiagnosisOutcome(facts, text, found.verdict)


def find_diagnosis(path: Path, config: Path | None = None) -> Json:
    """The mapping of diagnosis.json with the extended profile and the residuals added; no file is written."""
    found, gain = _diagnosed_with_gain(open_source(path, config), lambda _stage, _part: None, one_by_one)
    facts = as_json(found, gain, [[] for _ in found.causes])
    return {**facts, "extended_profile": profile_mapping(found.extended_profile), "residuals": found.residuals}


def _diagnosed_with_gain(source: Source, say: Progress, each: ParallelMap) -> tuple[Diagnosis, RestorationGain]:
    """The diagnosis, and what its causes gain on frames that no fit has used."""
    firsts = pairs_to_keep_back(source.capture, source.profile)
    as_given = begun(each, restore_pairs, source.capture, source.profile, firsts, source.pictures, source.gray)
    found = climb(source, lambda stage, part: say(stage, LADDER_PART * part), each, _of_pairs(firsts))
    say("restoring", LADDER_PART)
    profiles = found.nominal_profile, found.extended_profile
    before = as_given() if firsts and found.nominal_profile == source.profile else None
    return found, measure_restoration_gain(
        source.capture, *profiles, source.pictures, source.gray, each=each, firsts=firsts, before=before
    )


def _of_pairs(firsts: Collection[int]) -> list[int]:
    """Both frames of each pair."""
    return [first + step for first in firsts for step in (0, 1)]


def climb_as_command(source: Source) -> Diagnosis:
    """The diagnosis as `virest diagnose` makes it: frames for the restoration gain are held out."""
    kept_back = _of_pairs(pairs_to_keep_back(source.capture, source.profile))
    return climb(source, lambda _stage, _part: None, kept_back=kept_back)


def climb(
    source: Source, progress: Progress, each: ParallelMap = one_by_one, kept_back: Collection[int] = ()
) -> Diagnosis:
    """Run the ladder; kept_back: movie indices of frames held out of all fits."""
    from virest.diagnosis.ladder import diagnose_capture

    return diagnose_capture(source.capture, source.profile, source.pictures, source.gray, progress, each, kept_back)


def require_free(folder: Path, overwrite: bool) -> None:
    """Raise OutputError, before any work, if the results cannot be written there; a run of `process` may exist."""
    for path in (folder.parent, folder, folder / FIGURES):
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path}: is a file", hint="choose another folder with --out")
    if (folder / FIGURES).is_symlink():
        raise OutputError(f"{folder / FIGURES}: is a link", hint="choose another folder with --out")
    for name in (DIAGNOSIS, EXTENDED):
        if (folder / name).is_dir():
            raise OutputError(f"{folder / name}: is a folder", hint="choose another folder with --out")
    if (folder / DIAGNOSIS).exists() and not overwrite:
        raise OutputError(
            f"{folder}: already holds a diagnosis", hint="--overwrite replaces it, --out chooses another folder"
        )  # fmt: skip
    require_writable(folder)


def open_source(path: Path, config: Path | None = None) -> Source:
    """Read a capture with its profile; frames are decoded on demand."""
    capture = read_capture(path)
    for note in capture.notes:
        log.log(logging.INFO if note.severity == "info" else logging.WARNING, "%s: %s", capture.name, note.text)
    profile, origin = resolve_profile(capture, config)
    log.info("%s: camera profile from %s", capture.name, origin)
    index = probe_movie(capture.movie)
    return Source(capture, profile, RgbReader(capture.movie, index), GrayReader(capture.movie, index))


# ── diagnosis.json ───────────────────────────────────────────────────────────────────────────────────────────────


def as_json(found: Diagnosis, gain: RestorationGain, figures: Sequence[Sequence[str]]) -> Json:
    """The content of diagnosis.json; figures: paths for each cause, relative to the file."""
    content = {
        "schema": SCHEMA,
        "verdict": found.verdict,
        "nominal": dataclasses.asdict(found.nominal),
        "causes": [_cause(cause, paths) for cause, paths in zip(found.causes, figures, strict=True)],
        "fields": [_field(field, number) for number, field in enumerate(found.fields, start=1)],
        "unexplained": {
            "p_value": found.unexplained.p_value,
            "strongest_along": found.unexplained.strongest_along,
            "size": found.unexplained.size,
            "limit": found.unexplained.limit,
            "unit": found.unexplained.unit,
        },
        "restoration_gain": dataclasses.asdict(gain),
        "extended_profile": EXTENDED,
    }
    facts: Json = plain(content)
    return facts


def _cause(cause: Finding, figures: Sequence[str]) -> Json:
    held_out = cause.held_out
    return {
        "name": cause.name,
        "parameters": {
            name: {"nominal": change.nominal, "estimate": change.estimate, "std": change.std}
            for name, change in cause.parameters.items()
        },
        "held_out": {
            "quantity": held_out.quantity,
            "before": held_out.before,
            "after": held_out.after,
            "gain": held_out.gain,
        },
        "rivals": [dataclasses.asdict(rival) for rival in cause.rivals],
        "p_value": cause.p_value,
        "sentence": cause.sentence,
        "figures": list(figures),
    }


def _field(field: FieldFinding, number: int) -> Json:
    return field_record(
        field,
        field.held_out,
        stability=field.stability,
        imu_untrusted_s=[list(stretch) for stretch in field.stretches_s],
        figure=_field_path(number) if field.fields else None,
    )


def _field_path(number: int) -> str:
    return f"{FIGURES}/field_{number:02d}.png"


# ── extended.yaml ────────────────────────────────────────────────────────────────────────────────────────────────


def extended_text(name: str, found: Diagnosis) -> str:
    """The profile with every cause included, each with its standard deviation among the estimates."""
    profile = found.extended_profile
    for cause in found.causes:
        for parameter, change in cause.parameters.items():
            if change.estimate is not None and np.size(change.estimate) <= SHOWN_COMPONENTS:
                estimate, std = plain(change.estimate), _plain_std(change.std)
                profile = profile.with_estimate(parameter, estimate, std, f"virest diagnose, {cause.name}")
    fields = [f"{field.kind} over {', '.join(field.covariates)}" for field in found.fields]
    names = ", ".join([*(cause.name for cause in found.causes), *fields]) or "nothing to add"
    head = f"Camera profile by virest diagnose, from {name}: {found.verdict}: {names}"
    return commented([head]) + format_profile(profile)


def _plain_std(std: Any) -> Any:
    """A standard deviation as the profile stores it; None if unknown."""
    if std is None or not np.all(np.isfinite(np.asarray(std, float))):
        return None
    return plain(np.asarray(std, float))


# ── figures ──────────────────────────────────────────────────────────────────────────────────────────────────────


def draw_figures(
    capture: Capture, found: Diagnosis, each: ParallelMap = one_by_one
) -> tuple[dict[str, bytes], list[list[str]]]:
    """PNG files by path below the capture's output folder, and the paths that belong to each cause."""
    drawings: dict[str, tuple[Any, ...]] = {}
    before, after = found.residuals.get("before"), found.residuals.get("after")
    if before and after:
        title = f"{capture.name}: tracked − predicted points"
        drawings[f"{FIGURES}/residuals.png"] = (residual_figure, before, after, title)
    if found.ladder:
        rungs = [_bars(rung) for rung in found.ladder[:MAX_RUNGS]]
        drawings[f"{FIGURES}/ladder.png"] = (ladder_figure, rungs, f"{capture.name}: candidates tried")
    common = list(drawings)
    drawn = []
    for number, cause in enumerate(found.causes, start=1):
        rung = next((rung for rung in found.ladder if rung.has(cause.name)), None)
        own = f"{FIGURES}/{number:02d}_{cause.name}.png"
        if rung is not None:
            drawings[own] = (ladder_figure, [_bars(rung)], f"{capture.name}: candidates tried")
        drawn.append([own] if rung is not None else [])
    for number, field in enumerate(found.fields, start=1):
        if field.fields:
            drawings[_field_path(number)] = (field_figure, field, f"{capture.name}: {field.kind}", before, after)
    shots = _shots(capture, found)
    calls = [(simulated_frame, *shot) for shot in shots.values()]
    done = each(_called, [*calls, *drawings.values()])
    files = dict(zip(drawings, done[len(shots) :], strict=True))
    pictures = _pictures_figure(capture, dict(zip(shots, done, strict=False)), shots)
    if pictures is not None:
        files[f"{FIGURES}/pictures.png"] = pictures
        common.append(f"{FIGURES}/pictures.png")
    return files, [[*own, *common] for own in drawn]


def _called(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call the function; lets a ParallelMap run calls of different functions."""
    return function(*arguments)


def _bars(rung: Rung) -> tuple[str, float, dict[str, float], str | None]:
    return rung.quantity, rung.before, rung.tried, rung.entered


def _shots(capture: Capture, found: Diagnosis) -> dict[str, tuple[Capture, CameraProfile, int]]:
    """Arguments of :func:`simulated_frame` for one high-motion frame, by row label: with either profile."""
    firsts = chosen_pairs(capture, found.extended_profile)
    if not firsts:
        return {}
    profiles = {"profile as given": found.nominal_profile}
    if found.causes or found.fields:
        profiles["causes built in"] = found.extended_profile
    return {label: (capture, profile, firsts[len(firsts) // 2]) for label, profile in profiles.items()}


def _pictures_figure(
    capture: Capture, simulated: Mapping[str, Picture | None], shots: Mapping[str, tuple[Capture, CameraProfile, int]]
) -> bytes | None:
    """A high-motion frame beside its simulation from its restored neighbour, with either profile."""
    number = next((number for _, _, number in shots.values()), None)
    if number is None:
        return None
    _, measured = next(read_frames(capture.movie, probe_movie(capture.movie), number, number), (number, None))
    rows = [
        (label, measured, picture)
        for label, picture in simulated.items()
        if measured is not None and picture is not None
    ]
    return comparison_figure(rows, f"{capture.name}: frame {number}") if rows else None


def simulated_frame(capture: Capture, profile: CameraProfile, number: int) -> Picture | None:
    """Frame ``number`` as simulated from the restored next frame; None if that fails."""
    plan = RestorationPlan(profile, PRESETS["balanced"], imu_gaps_s=capture.imu_gaps_s)
    if _blur_px(capture, profile, number) >= min(capture.width, capture.height):
        log.info("%s: frame %d was not simulated: its blur would be longer than the picture", capture.name, number)
        return None
    try:
        scene = restored_scene(capture, plan, number + 1)
        if scene is None:
            return None
        frames = capture.frames[number : number + 2]
        session = recreate_session(capture, frames, profile, profile, scene, SessionSettings(noise_levels=0.0))
    except VirestError as error:
        log.info("%s: frame %d could not be simulated: %s", capture.name, number, error)
        return None
    return render_picture(session, 0)


def _blur_px(capture: Capture, profile: CameraProfile, number: int) -> float:
    """Length of a frame's blur at the highest rate in its exposure, by the gyroscope; 0 without a focal length."""
    frame = capture.frames[number]
    exposure_s, clock = frame.exposure_s or 0.0, RowClock(profile)
    during = capture.imu.between(clock.time_s(frame.time_s, exposure_s), clock.end_s(frame.time_s, exposure_s))
    if profile.intrinsics is None or not len(during):
        return 0.0
    rate_rad_s = np.linalg.norm(profile.true_rate_rad_s(during.gyro_rad_s), axis=1)
    return float(rate_rad_s.max()) * profile.shutter.true_exposure_s(exposure_s) * profile.intrinsics.fx_px


# ── files ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _write_all(folder: Path, files: dict[str, bytes]) -> None:
    """Write the files in order, diagnosis.json last; if one cannot be written, remove all new files."""
    folders = [folder, folder / FIGURES]
    new_folders = [path for path in folders if not path.exists()]
    new_files = [folder / name for name in files if not (folder / name).exists()]
    try:
        for path in folders:
            path.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            write_whole(folder / name, data)
        for old in (folder / FIGURES).iterdir():
            if FIGURE.fullmatch(old.name) and f"{FIGURES}/{old.name}" not in files:
                old.unlink()
    except BaseException as error:
        with suppress(OSError):
            for file in new_files:
                file.unlink(missing_ok=True)
            for path in reversed(new_folders):
                path.rmdir()
        if isinstance(error, OSError):
            raise output_error(folder, error) from error
        raise
