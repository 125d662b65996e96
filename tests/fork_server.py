"""``python -m virest`` without the second of imports: a process that has loaded the package forks one for each call.

The forked process is what the program is when it starts: arguments, folder, variables, standard streams and exit code.
What a start itself does (lazy imports, variables that libraries read as they load) is tested by true starts.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import pkgutil
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from types import TracebackType
from typing import IO, NoReturn


class ForkServer:
    """Calls of the program, one after the other."""

    process: subprocess.Popen[str] | None = None

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process is not None:
            self.process.communicate()

    def run(
        self, arguments: list[str], cwd: Path | None, stdin: str, timeout: float
    ) -> subprocess.CompletedProcess[str]:
        """Run the program with arguments in a folder; its exit code and what it wrote. After ``timeout`` s it ends."""
        if self.process is None:
            self.process = subprocess.Popen(
                [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        with tempfile.TemporaryDirectory() as folder:
            streams = [os.path.join(folder, name) for name in ("in", "out", "err")]
            Path(streams[0]).write_text(stdin)
            call = {"arguments": arguments, "cwd": os.fspath(cwd or os.getcwd()), "streams": streams, "s": timeout}
            call["environment"] = dict(os.environ)
            assert self.process.stdin is not None
            assert self.process.stdout is not None
            print(json.dumps(call), file=self.process.stdin, flush=True)
            status = int(self.process.stdout.readline())
            out, err = (Path(name).read_text() for name in streams[1:])
        return subprocess.CompletedProcess(arguments, os.waitstatus_to_exitcode(status), out, err)


def serve(calls: IO[str], answers: IO[str]) -> None:
    """Fork a program for each line, and answer its status."""
    importlib.import_module("pandas")  # loaded only once a table is read
    package = importlib.import_module("virest")
    for module in pkgutil.walk_packages(package.__path__, "virest."):
        if not module.name.endswith("__main__"):
            with contextlib.suppress(ImportError):
                importlib.import_module(module.name)
    gc.freeze()
    for line in calls:
        call = json.loads(line)
        child = os.fork()
        if not child:
            signal.alarm(int(call["s"]))
            os.environ.clear()
            os.environ.update(call["environment"])
            become(call["arguments"], call["cwd"], call["streams"])
        print(os.waitpid(child, 0)[1], file=answers, flush=True)


def become(arguments: list[str], cwd: str, streams: list[str]) -> None:
    """Be the program from here on."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(cwd)
    for number, (name, flags) in enumerate(zip(streams, (os.O_RDONLY, *[os.O_WRONLY | os.O_CREAT] * 2), strict=True)):
        os.dup2(os.open(name, flags, 0o600), number)
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        stream = open(number, mode, closefd=False)  # noqa: SIM115
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    sys.argv = ["virest", *arguments]
    try:
        runpy.run_module("virest", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if isinstance(end.code, str):
            raise
        leave(end.code or 0)
    leave(0)


def leave(code: int) -> NoReturn:
    """End as the interpreter does, but for taking apart all that is loaded: that is a tenth of a second.

    What a library raises at the end is ignored, as by the interpreter: executors of 3.11 may wake a closed pipe.
    """
    with contextlib.suppress(OSError):
        threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    serve(sys.stdin, sys.stdout)
