"""The command line. Heavy imports happen inside the commands; ``main`` is the one exit door."""

from __future__ import annotations

import errno
import signal
import sys
from typing import Any, NoReturn

import typer

from virest.app import console
from virest.app.cli.calibrate import calibrate
from virest.app.cli.calibrate_curve import calibrate_curve
from virest.app.cli.criticise import criticise
from virest.app.cli.diagnose import diagnose
from virest.app.cli.evaluate import evaluate
from virest.app.cli.export import export
from virest.app.cli.inspect import inspect
from virest.app.cli.options import Version
from virest.app.cli.process import process
from virest.app.cli.report import report
from virest.app.cli.simulate import simulate
from virest.errors import OutputError

USAGE = 2
INTERRUPTED = 130
TERMINATED = 143
CLOSED_PIPE = 141
_SYSTEM_HINTS = {
    errno.ENOSPC: "free some space there",
    errno.EDQUOT: "your quota is used up; free some space there",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "a link of this path leads back to itself; choose another",
}

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


@app.callback()
def _virest(version: Version = False) -> None:
    pass


for command in (process, inspect, simulate, calibrate, diagnose, criticise, report, export):
    app.command()(command)
app.command("calibrate-curve")(calibrate_curve)
app.add_typer(evaluate, name="evaluate")


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
        return console.report_error(_beyond_us(error) or error)


def _beyond_us(error: Exception) -> OutputError | None:
    """What the system says of a path that nobody looked at before: the disk is full, or the path cannot be."""
    if not isinstance(error, OSError) or error.errno not in _SYSTEM_HINTS:
        return None
    return OutputError(f"{error.filename or 'output'}: {error.strerror}", hint=_SYSTEM_HINTS[error.errno])


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
