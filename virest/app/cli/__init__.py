"""The command line. Commands import heavy modules only when they run; every exit goes through ``main``."""

from __future__ import annotations

import errno
import signal
import sys
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, NoReturn

import typer

from virest.app import console
from virest.app.cli.calibrate import calibrate
from virest.app.cli.calibrate_curve import calibrate_curve
from virest.app.cli.criticise import criticise
from virest.app.cli.diagnose import diagnose
from virest.app.cli.doctor import doctor
from virest.app.cli.evaluate import evaluate
from virest.app.cli.export import export
from virest.app.cli.import_bag import import_bag
from virest.app.cli.inspect import inspect
from virest.app.cli.options import GroupedCommand, Version
from virest.app.cli.preview import preview
from virest.app.cli.process import process
from virest.app.cli.profile import profile
from virest.app.cli.report import report
from virest.app.cli.simulate import simulate
from virest.errors import OutputError

USAGE = 2
INTERRUPTED = 130
TERMINATED = 143
CLOSED_PIPE = 141
"""Exit codes: 2 as usual for wrong usage, else 128 + the signal (SIGINT 2, SIGTERM 15, SIGPIPE 13), as shells do."""
_SYSTEM_HINTS = {
    errno.ENOSPC: "free some space there",
    errno.EDQUOT: "your disk quota is exhausted; free some space there",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "the path contains a circular link; choose another",
    errno.EROFS: "the disk is read-only; choose another folder",
    errno.EACCES: "no permission there; choose another folder, or change its permissions",
    errno.EPERM: "no permission there; choose another folder, or change its permissions",
    errno.ENOTDIR: "part of this path is a file; choose another folder",
}

app = typer.Typer(
    add_completion=True,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    help="Deblur phone captures and correct their rolling shutter with the phone's own gyroscope.",
)
_ClickException: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


class _Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM, SIGHUP): clean up as after Ctrl-C."""


def _show_manual(wanted: bool) -> None:
    """Print the manual page and exit: `--man`."""
    if wanted:
        from virest.app.man import man_page

        console.emit(man_page(program()).rstrip("\n"))
        raise typer.Exit


Manual = Annotated[
    bool, typer.Option("--man", help="Print the manual page, virest.1.", is_eager=True, callback=_show_manual)
]


@app.callback()
def _virest(version: Version = False, manual: Manual = False) -> None:
    pass


COMMANDS: dict[str, tuple[Callable[..., int], str]] = {
    "process": (process, "Deblur and straighten captures (the main command)."),
    "preview": (preview, "Show one frame before and after, in seconds."),
    "inspect": (inspect, "List what a capture holds and what is wrong with it."),
    "calibrate": (calibrate, "Fit clock, readout, axes and bias to a capture."),
    "calibrate-curve": (calibrate_curve, "Fit the exposure curve."),
    "diagnose": (diagnose, "Find what the camera model gets wrong, and why."),
    "criticise": (criticise, "Find what the residuals of any calibration depend on."),
    "simulate": (simulate, "Write a capture with known ground truth."),
    "import": (import_bag, "Convert a ROS bag or MCAP file to a capture."),
    "export": (export, "Write formats for SLAM, COLMAP, nerfstudio, Gyroflow."),
    "report": (report, "Show a run as one HTML page."),
    "doctor": (doctor, "Check the installation."),
}
"""Each command with the line that ``virest --help`` shows."""
for name, (command, line) in COMMANDS.items():
    app.command(name, short_help=line, cls=GroupedCommand)(command)
app.add_typer(evaluate, name="evaluate", short_help="Measure quality against ground truth and other methods.")
app.add_typer(profile, name="profile", short_help="Create a camera profile; list known phones.")


def _terminate(number: int, _frame: Any) -> NoReturn:
    raise _Terminated(number)


@cache
def program() -> Any:
    """The command tree for the parser; arguments are shown by name, without their Python type."""
    command = typer.main.get_command(app)
    _name_arguments(command)
    return command


def _name_arguments(command: Any) -> None:
    """Show arguments as manual pages do: NAME, [NAME] if optional, NAME... if several are accepted."""
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            name = parameter.metavar or parameter.name.upper()
            shown = (name if parameter.required else f"[{name}]") + ("..." if parameter.nargs == -1 else "")
            parameter.display_type_rich = lambda ctx: None
            parameter.get_usage_pieces = lambda ctx, shown=shown: [shown]
    for inner in getattr(command, "commands", {}).values():
        _name_arguments(inner)


def run(arguments: list[str] | None = None) -> int:
    """Run one command and turn any outcome into an exit code."""
    command = program()
    words = list(sys.argv[1:] if arguments is None else arguments)
    resume_hint = "; finished work is kept, --resume continues from there" if "process" in words[:1] else ""
    try:
        with command.make_context("virest", list(words)) as context:
            code = command.invoke(context)
        return code if isinstance(code, int) else 0
    except typer.Exit as leaving:
        return leaving.exit_code
    except _ClickException as error:
        _report_usage(error)
        return USAGE
    except _Terminated:
        console.CONSOLE.line(f"terminated{resume_hint}")
        return TERMINATED
    except (KeyboardInterrupt, typer.Abort):
        console.CONSOLE.line(f"interrupted{resume_hint}")
        return INTERRUPTED
    except BrokenPipeError:
        console.silence_stdout()
        return CLOSED_PIPE
    except Exception as error:
        return console.report_error(_file_system_error(error) or error)


def _file_system_error(error: Exception) -> OutputError | None:
    """An operating-system error about a path that was not checked before: disk full, no permission, path too long."""
    if not isinstance(error, OSError) or error.errno not in _SYSTEM_HINTS:
        return None
    return OutputError(f"{error.filename or 'output'}: {error.strerror}", hint=_SYSTEM_HINTS[error.errno])


def _report_usage(error: Any) -> None:
    """One line for a usage error; the help text if the command was given no arguments."""
    if type(error).__name__ == "NoArgsIsHelpError":
        console.CONSOLE.block(error.format_message() + "\n")
        return
    name = error.ctx.command_path if getattr(error, "ctx", None) else "virest"
    console.CONSOLE.line(f"error: {error.format_message().rstrip('.')}; see {name} --help")


def main() -> NoReturn:
    """The console script."""
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):  # Windows has no SIGHUP
            signal.signal(getattr(signal, name), _terminate)
    code = run()
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        console.silence_stdout()
    sys.exit(code)
