"""The command line. Heavy imports happen inside the commands; ``main`` is the one exit door."""

from __future__ import annotations

import errno
import logging
import os
import re
import shlex
import signal
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from virest import __version__
from virest.app import console
from virest.errors import OutputError, VirestError
from virest.restoration.settings import DEBLUR_METHODS, PRESETS, REFERENCES, SHUTTER_METHODS

log = logging.getLogger(__name__)

DIRECTIONS = ("top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left")
CALIBRATED_EXTRAS = (
    "focal",
    "distortion",
    "principal-point",
    "gyro-scale",
    "clock-skew",
    "exposure-scale",
    "frame-lag",
)
LIKE_OPTIONS = (
    "out",
    "like",
    "frames",
    "config",
    "noise",
    "effect",
    "reference",
    "seed",
    "overwrite",
    "json",
    "quiet",
    "verbose",
    "version",
)
"""What `simulate --like` heeds; all else is the capture's."""
CURVE_KINDS = ("auto", "linear", "five_segment", "gamma", "srgb", "table")
USAGE = 2
INTERRUPTED = 130
TERMINATED = 143
CLOSED_PIPE = 141
PARTLY_FAILED = 9

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    help="Deblur and straighten phone captures with the phone's own gyroscope.",
)
_ClickException: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


class _Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM, SIGHUP): leave as tidily as after Ctrl-C."""


# ── options that several commands share ──────────────────────────────────────────────────────────────────────────


def _show_version(wanted: bool) -> None:
    if wanted:
        console.emit(f"virest {__version__}")
        raise typer.Exit


def _one_of(names: tuple[str, ...]) -> Callable[[str | None], str | None]:
    def check(value: str | None) -> str | None:
        if value is not None and value not in names:
            raise typer.BadParameter(f"{value!r} is none of {', '.join(names)}")
        return value

    return check


Captures = Annotated[list[str], typer.Argument(metavar="CAPTURE", help="Capture folders; - reads names from stdin.")]
Json = Annotated[bool, typer.Option("--json", help="Machine-readable results on standard output, nothing else.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Errors only.")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Say more; tracebacks for errors.")]
Version = Annotated[
    bool, typer.Option("--version", help="Print the version and leave.", is_eager=True, callback=_show_version)
]
Config = Annotated[Path | None, typer.Option("--config", metavar="FILE", help="Camera profile, or a Kalibr camchain.")]


@app.callback()
def _virest(version: Version = False) -> None:
    pass


def _parse_frames(text: str | None) -> slice:
    """A Python slice of frame indices, ``A:B`` or ``A:B:STEP``."""
    if text is None:
        return slice(None)
    parts = text.split(":")
    if len(parts) not in (2, 3) or not all(re.fullmatch(r"\s*([+-]?\d{1,18})?\s*", part, re.ASCII) for part in parts):
        raise typer.BadParameter(f"{text!r} is no slice; write A:B or A:B:STEP, such as 10:50, :100 or ::5")
    bounds = [int(part) if part.strip() else None for part in parts]
    if len(bounds) == 3 and bounds[2] == 0:
        raise typer.BadParameter(f"{text!r}: the step cannot be 0")
    return slice(*bounds)


# ── commands ─────────────────────────────────────────────────────────────────────────────────────────────────────


@app.command()
def process(
    captures: Captures,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="One folder a capture goes in here.")] = Path(
        "virest-out"
    ),
    config: Config = None,
    settings: Annotated[Path | None, typer.Option(metavar="FILE", help="Settings, as configs/balanced.yaml.")] = None,
    frames: Annotated[
        str | None, typer.Option(metavar="A:B[:STEP]", help="Only these frames: a Python slice of the movie's indices.")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(metavar="|".join(PRESETS), callback=_one_of(tuple(PRESETS)), help="[balanced]")
    ] = None,
    deblur: Annotated[
        str | None,
        typer.Option(metavar="METHOD", callback=_one_of(DEBLUR_METHODS), help=f"One of {', '.join(DEBLUR_METHODS)}."),
    ] = None,
    shutter: Annotated[
        str | None,
        typer.Option(metavar="|".join(SHUTTER_METHODS), callback=_one_of(SHUTTER_METHODS), help="[rowwise]"),
    ] = None,
    reference: Annotated[
        str | None,
        typer.Option(
            metavar="|".join(REFERENCES), callback=_one_of(REFERENCES), help="Time of the picture. [exposure-start]"
        ),
    ] = None,
    jobs: Annotated[int | None, typer.Option(metavar="N", min=1, help="Processes. [the cores]")] = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler does the work.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was interrupted.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing run.")] = False,
    keep_start_up: Annotated[
        bool, typer.Option("--keep-start-up", help="Process the frames of the recorder's start-up too.")
    ] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Deblur and straighten captures: PNGs, parameters.jsonl and run.json in OUT/<capture>.

    \b
    $ virest process 2022_03_09_15_21_07 --frames 30:90
    virest: 2022_03_09_15_21_07: camera profile from the capture's metadata
    capture              restored  copied  skipped  failed  frames/s  verdict   output
    2022_03_09_15_21_07        58       2        0       0       4.3  restored  virest-out/2022_03_09_15_21_07

    \b
    $ find /data -name movie.mp4 -printf '%h\\n' | virest process - --json | jq .blur.length_px
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    if resume and overwrite:
        raise typer.BadParameter("choose one of --resume and --overwrite")
    if scheduler is not None and find_spec("distributed") is None:
        raise typer.BadParameter("--scheduler needs the extra [cluster]: pip install 'virest[cluster]'")
    chosen = _parse_frames(frames)
    paths = _capture_paths(captures)
    if not paths:
        return 0
    _one_thread_each()
    from virest.app.process import ProcessOptions, process_captures
    from virest.app.settings import compose_settings

    composed = compose_settings(
        settings,
        preset=preset,
        deblur=deblur,
        shutter=shutter,
        reference=reference,
        keep_start_up=keep_start_up or None,
    )
    options = ProcessOptions(
        out,
        composed,
        config,
        chosen,
        jobs or _cores(),
        scheduler,
        "resume" if resume else "overwrite" if overwrite else "new",
        shlex.join(["virest", *sys.argv[1:]]),
        json,
        quiet,
        verbose,
    )
    return process_captures(paths, options)


@app.command()
def inspect(
    captures: Captures,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Say what is in a capture and what is wrong with it, before any work.

    \b
    $ virest inspect honor_v10
    $ virest inspect honor_v10 --json | jq .frames
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    paths = _capture_paths(captures)
    from virest.app.inspect import inspect_capture

    codes = []
    for path in paths:
        try:
            facts, text, code = inspect_capture(Path(path))
            if json:
                from virest.app.outputs import json_line

                console.emit(json_line(facts))
            else:
                console.emit(text)
            if code:
                console.CONSOLE.line(f"error: {_first_error(facts)}")
        except VirestError as error:
            code = console.report_error(error)
        codes.append(code)
    return _batch_code(codes)


def _parse_exposures(text: str) -> list[float]:
    """Exposures in milliseconds, separated by commas."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no list of milliseconds; write 10 or 5,10,20") from None


def _parse_auto_exposure(text: str | None) -> tuple[float | None, int | None]:
    """Parse a range in EV, and the number of exposures where a staircase is asked for: ``4`` or ``6:9``."""
    if text is None:
        return None, None
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(?::\s*([0-9]{1,6})\s*)?", text, re.ASCII)
    if found is None:
        raise typer.BadParameter(f"{text!r} is no range of exposures; write 4 (a smooth walk), or 6:9 (nine steps)")
    return float(found[1]), None if found[2] is None else int(found[2])


def _describe_simulation(facts: dict[str, Any]) -> str:
    effects = [
        f"{effect['name']} ({', '.join(f'{name} {value}' for name, value in effect['parameters'].items())})"
        for effect in facts["effects"]
    ]
    size = f"{facts['frames']} frames of {facts['width']}x{facts['height']}"
    return f"{facts['capture']}: {size}, blur {facts['blur_px']} px, effects: {', '.join(effects) or 'none'}"


def _first_error(facts: dict[str, Any]) -> str:
    """What makes a capture unusable, of all that was noted."""
    errors = [note["text"] for note in facts["notes"] if note["severity"] == "error"]
    return errors[0] if errors else f"{facts['capture']}: cannot be used"


@app.command()
def simulate(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the capture to write.")],
    like: Annotated[
        Path | None,
        typer.Option(metavar="CAPTURE", help="Re-create this capture: its camera, times, exposures and motion."),
    ] = None,
    scene: Annotated[str, typer.Option(metavar="KIND", help="leaves, bright, board or text.")] = "leaves",
    width: Annotated[int, typer.Option(metavar="PX")] = 720,
    height: Annotated[int, typer.Option(metavar="PX")] = 1280,
    frames: Annotated[
        str | None, typer.Option(metavar="N", help="How many. With --like A:B, these of its frames. [12; all]")
    ] = None,
    fps: Annotated[float, typer.Option(metavar="HZ", help="Frames a second.")] = 30.0,
    exposure_ms: Annotated[str, typer.Option(metavar="MS[,MS...]", help="Exposure; several are taken in turn.")] = "10",
    auto_exposure: Annotated[
        str | None,
        typer.Option(
            metavar="EV[:STEPS]",
            help="Exposure x ISO and the brightness change by EV: a smooth walk, or STEPS exposures. [they stay]",
        ),
    ] = None,
    readout_ms: Annotated[float, typer.Option(metavar="MS", help="First row to one past the last.")] = 20.0,
    direction: Annotated[
        str | None,
        typer.Option(metavar="DIRECTION", callback=_one_of(DIRECTIONS), help=f"Readout: {', '.join(DIRECTIONS)}."),
    ] = None,
    focal_px: Annotated[float | None, typer.Option(metavar="PX", help="Focal length.")] = None,
    rate: Annotated[float, typer.Option(metavar="RAD_S", help="How fast the hand turns; 0: not at all.")] = 1.0,
    noise: Annotated[float, typer.Option(metavar="LEVELS", help="Noise of the picture, grey levels.")] = 1.5,
    response: Annotated[
        str, typer.Option(metavar="CURVE", help="srgb, linear, gamma:2.2, five_segment[:xb,yb,xc,yc,y_max].")
    ] = "srgb",
    depth_m: Annotated[float | None, typer.Option(metavar="M", help="Distance of the scene. [infinity]")] = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="Take the camera from this profile.")] = None,
    effect: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=VALUE]", help="Hide this effect in the capture; may be repeated."),
    ] = None,
    reference: Annotated[
        str, typer.Option(metavar="|".join(REFERENCES), callback=_one_of(REFERENCES), help="Of the truth pictures.")
    ] = REFERENCES[0],
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="The same seed gives the same capture.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a simulated capture.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Write a capture with known truth: movie, logs, camera.yaml, and truth/ with sharp frames and the motion.

    \b
    $ virest simulate leaves --frames 20 --rate 1.5 --effect time_offset=0.012
    leaves: 20 frames of 720x1280, blur 9.1 px, effects: time_offset (time_offset_s 0.012)
    $ virest process leaves

    \b
    $ virest simulate bracket --auto-exposure 5:9 --rate 0 --exposure-ms 4 --frames 27
    $ virest calibrate-curve bracket

    \b
    $ virest simulate again --like 2022_03_09_15_21_07 --frames 30:90 --effect flicker=0.2,100
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    if like is not None:
        _require_only(context, LIKE_OPTIONS, "--like takes it from the capture")
        wishes = {"noise_levels": noise, "effects": effect or [], "reference": reference, "seed": seed}
        facts = _simulate_like(out, like, config, frames, quiet, overwrite=overwrite, **wishes)
        _emit_facts(facts, _describe_simulation(facts), as_json=json)
        return 0
    count = _parse_count(frames, 12)
    exposures_ms = _parse_exposures(exposure_ms)
    auto_exposure_ev, auto_exposure_steps = _parse_auto_exposure(auto_exposure)
    _one_thread_each()
    from virest.app.simulate import simulate_command
    from virest.camera.profile import read_profile

    with console.progress_bar(count, "simulate", quiet=quiet) as bar:
        facts = simulate_command(
            out,
            scene=scene,
            width=width,
            height=height,
            frames=count,
            fps=fps,
            exposure_ms=exposures_ms,
            auto_exposure_ev=auto_exposure_ev,
            auto_exposure_steps=auto_exposure_steps,
            readout_ms=readout_ms,
            direction=direction,
            focal_px=focal_px,
            rate_rad_s=rate,
            noise_levels=noise,
            response=response,
            depth_m=depth_m,
            profile=read_profile(config) if config else None,
            effects=effect or [],
            reference=reference,
            seed=seed,
            overwrite=overwrite,
            progress=(lambda _done, _total: bar.update(1)) if bar else None,
        )
    _emit_facts(facts, _describe_simulation(facts), as_json=json)
    return 0


@app.command()
def calibrate(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Capture folder; - reads its name from stdin.")],
    config: Config = None,
    extra: Annotated[
        list[str] | None,
        typer.Option("--with", metavar="NAME,...", help=f"Fit these too: {', '.join(CALIBRATED_EXTRAS)}."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The calibrated profile goes here.")] = Path(
        "camera.yaml"
    ),
    kalibr: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write Kalibr's camchain-imucam.yaml and imu.yaml in here too.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Fit time offset, readout, IMU-camera rotation and gyroscope bias to an ordinary capture.

    \b
    $ virest calibrate shaken --with focal
    shaken: calibrated
    value                       start     calibrated        ±  determined  note
    time_offset_s            0.000000       0.030998  3.9e-05  yes
    readout_time_s           0.020000       0.022700  6.7e-05  yes
    readout_direction   right_to_left  right_to_left           yes
    ...
    residual 0.399 -> 0.123 px, of which tracking makes 0.123 px
    wrote camera.yaml

    \b
    $ virest calibrate shaken --json --out found.yaml | jq '.values[] | select(.determined) | .name, .value, .std'
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    _one_thread_each()
    from virest.app.calibrate import CalibrationOutput, plan_calibration, run_calibration

    names = _parse_extras(extra or [])
    output = CalibrationOutput(out, kalibr, overwrite)
    output.require()
    paths = console.expand_dash([capture])
    if len(paths) != 1:
        raise typer.BadParameter(f"standard input names {len(paths)} captures; a profile is calibrated from one")
    plan = plan_calibration(Path(paths[0]), config, names)
    with console.progress_bar(plan.steps, "calibrate", quiet=quiet) as bar:
        facts, text = run_calibration(plan, output, bar.update if bar else None)
    if json:
        from virest.app.outputs import json_line

        text = json_line(facts)
    console.emit(text)
    return 0


@app.command()
def diagnose(
    capture: Annotated[str, typer.Argument(metavar="CAPTURE", help="Capture folder.")],
    config: Config = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="The capture's folder in here takes the results.")
    ] = Path("virest-out"),
    check: Annotated[bool, typer.Option("--check", help="Exit with 10 unless the verdict is consistent.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing diagnosis.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Say what the camera model gets wrong on a capture, why, what to add, and what that gains.

    \b
    $ virest diagnose shaken
    shaken: 13774 tracks in 60 frames, off by 1.336 px, of which tracking makes 0.1759 px
    cause              parameter  given    found          ±  before   after  gain  held out         rivals
    readout_time  readout_time_s  0.022  0.01493  5.607e-05   1.339  0.1836  100%  geometry_rms_px  -
    readout_time: the rows are read within 0.01493 s
    restored: sharpness 7.018 recorded, 7.575 as given, 7.72 extended; neighbours disagree by 1.657 -> 0.1961 px
    unexplained: nothing of size; 0.02081 px along time
    wrote virest-out/shaken/diagnosis.json, extended.yaml and figures
    verdict: explained
    $ virest process shaken --config virest-out/shaken/extended.yaml --out better
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    _one_thread_each()
    from virest.app.diagnose import DiagnosisOptions, run_diagnosis

    with console.progress_bar(100, "diagnose", quiet=quiet) as bar:
        outcome = run_diagnosis(capture, DiagnosisOptions(out, config, overwrite), _on_bar(bar))
    _emit_facts(outcome.facts, outcome.text, as_json=json)
    return outcome.check_code if check else 0


@app.command("calibrate-curve")
def calibrate_curve(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Folder of bracketed stills, or a capture.")],
    exposures: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Exposure times: columns file,exposure_s. [EXIF]")
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(metavar="KIND", callback=_one_of(CURVE_KINDS), help=f"{', '.join(CURVE_KINDS)}. [auto]"),
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The response block goes here.")] = Path(
        "curve.yaml"
    ),
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Curve, data, residuals: png, svg or pdf.")] = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Version = False,
) -> int:
    """Fit the exposure characteristic curve to pictures of one still scene at several exposures.

    \b
    $ virest calibrate-curve bracket --exposures bracket/exposures.csv --plot curve.png
    gamma 2.1998
    fit error 0.47 grey levels rms, exposures 0.0009 to 0.92 covered
    """  # noqa: D301
    console.configure(quiet=quiet, verbose=verbose)
    _one_thread_each()
    from virest.app.calibrate_curve import calibrate_curve as fit_and_write
    from virest.app.calibrate_curve import plot_format_known

    if plot is not None and not plot_format_known(plot):
        raise typer.BadParameter(f"--plot {plot.name}: the name must end in .png, .svg or .pdf")
    facts, text = fit_and_write(source, exposures=exposures, kind=kind or "auto", out=out, plot=plot)
    if json:
        from virest.app.outputs import json_line

        text = json_line(facts)
    console.emit(text)
    return 0


# ── help for the commands ────────────────────────────────────────────────────────────────────────────────────────


def _emit_facts(facts: dict[str, Any], text: str, *, as_json: bool) -> None:
    from virest.app.outputs import json_line

    console.emit(json_line(facts) if as_json else text)


def _on_bar(bar: Any) -> Callable[[str, float], None] | None:
    """Show the part that is done and the stage on a bar of 100."""
    if bar is None:
        return None

    def show(stage: str, part: float) -> None:
        bar.set_description(f"diagnose: {stage}", refresh=False)
        bar.update(max(round(100 * part) - bar.n, 0))

    bar.unit = "%"
    return show


def _require_only(context: typer.Context, allowed: tuple[str, ...], why: str) -> None:
    """Refuse options that were typed and would do nothing."""
    for name in context.params:
        source = context.get_parameter_source(name)
        if name not in allowed and source is not None and source.name == "COMMANDLINE":
            raise typer.BadParameter(f"--{name.replace('_', '-')}: {why}")


def _parse_count(text: str | None, default: int) -> int:
    if text is None:
        return default
    if not re.fullmatch(r"\s*[+-]?\d{1,9}\s*", text, re.ASCII):
        raise typer.BadParameter(f"--frames {text!r} is no number; A:B is for --like")
    return int(text)


def _simulate_like(
    out: Path, like: Path, config: Path | None, frames: str | None, quiet: bool, **wishes: Any
) -> dict[str, Any]:
    """Re-create a capture; a bare N of ``--frames`` means its first N."""
    chosen = _parse_frames(frames if frames is None or ":" in frames else f":{frames}")
    _one_thread_each()
    from virest.app.recreate import count_frames, simulate_like

    with console.progress_bar(count_frames(like, chosen), "simulate", quiet=quiet) as bar:
        step = (lambda _done, _total: bar.update(1)) if bar else None
        return simulate_like(out, like, config=config, frames=chosen, progress=step, **wishes)


def _parse_extras(options: list[str]) -> tuple[str, ...]:
    """Names of ``--with``, each once; every option may hold several, separated by commas."""
    from virest.app.calibrate import unknown_extra

    names = tuple(dict.fromkeys(name.strip() for option in options for name in option.split(",") if name.strip()))
    for complaint in filter(None, map(unknown_extra, names)):
        raise typer.BadParameter(f"--with {complaint}")
    return names


def _capture_paths(captures: list[str]) -> list[str]:
    paths = console.expand_dash(captures)
    if not paths:
        log.warning("no capture: standard input names none")
    return paths


def _batch_code(codes: list[int]) -> int:
    failures = [code for code in codes if code]
    return 0 if not failures else failures[0] if len(codes) == 1 else PARTLY_FAILED


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _one_thread_each() -> None:
    """One thread in each process's linear algebra: the same sums on every machine, and no more threads than cores."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"


# ── the exit door ────────────────────────────────────────────────────────────────────────────────────────────────


def _terminate(number: int, _frame: Any) -> NoReturn:
    raise _Terminated(number)


def run(arguments: list[str] | None = None) -> int:
    """Run one command and turn whatever happens into an exit code."""
    command = typer.main.get_command(app)
    try:
        with command.make_context("virest", list(sys.argv[1:] if arguments is None else arguments)) as context:
            code = command.invoke(context)
        return code if isinstance(code, int) else 0
    except typer.Exit as leaving:
        return leaving.exit_code
    except _ClickException as error:
        _report_usage(error)
        return USAGE
    except _Terminated:
        console.CONSOLE.line("terminated; what is done stays, --resume goes on from there")
        return TERMINATED
    except (KeyboardInterrupt, typer.Abort):
        console.CONSOLE.line("interrupted; what is done stays, --resume goes on from there")
        return INTERRUPTED
    except BrokenPipeError:
        console.silence_stdout()
        return CLOSED_PIPE
    except Exception as error:
        return console.report_error(_disk_full(error) or error)


def _disk_full(error: Exception) -> OutputError | None:
    """The error of an output that takes nothing more, wherever it was met."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return OutputError(f"{error.filename or 'output'}: {error.strerror}", hint="free some space there")
    return None


def _report_usage(error: Any) -> None:
    """One line for a wrong call; the help where nothing was asked for."""
    if type(error).__name__ == "NoArgsIsHelpError":
        console.CONSOLE.block(error.format_message() + "\n")
        return
    name = error.ctx.command_path if getattr(error, "ctx", None) else "virest"
    console.CONSOLE.line(f"error: {error.format_message().rstrip('.')}; see {name} --help")


def main() -> NoReturn:
    """The console script."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _terminate)
    code = run()
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        console.silence_stdout()
    sys.exit(code)
