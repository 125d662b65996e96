"""``python -m virest`` without a second of imports: a process that has loaded the package forks for each call.

The forked process has the state of the program at its start: arguments, folder, variables, standard streams and exit
code. What a real start adds (lazy imports, variables that libraries read when loaded) is tested by real starts.
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
import select
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, NoReturn

LAZY = ("pandas", "typer._adapters", "pydantic.type_adapter", "matplotlib.figure", "matplotlib.backends.backend_agg")
"""Modules that the program loads only when it reads a table, checks an option or draws a figure."""
MOST_BYTES = 1 << 20
"""Largest call: arguments and variables."""
LONGEST_S = 1200.0
"""Longest call from a shell."""


class ForkServer:
    """Calls of the program, one after the other."""

    process: subprocess.Popen[str] | None = None
    folder: tempfile.TemporaryDirectory[str] | None = None

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process is not None and self.folder is not None:
            self.process.communicate()
            self.folder.cleanup()

    def address(self) -> str:
        """The address of the server; the first use starts it."""
        if self.folder is None:
            self.folder = tempfile.TemporaryDirectory()
            self.process = subprocess.Popen(
                [sys.executable, __file__, "serve", os.path.join(self.folder.name, "calls")],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            )  # fmt: skip
            assert self.process.stdout is not None
            self.process.stdout.readline()
        return os.path.join(self.folder.name, "calls")

    def shell_function(self) -> dict[str, str]:
        """The variable that makes every bash started with it run ``virest`` as a call of the server."""
        client = shlex.join([sys.executable, "-SE", __file__, "call", self.address()])
        return {"BASH_FUNC_virest%%": f'() {{ {client} "$@"; }}'}

    def run(
        self, arguments: list[str], cwd: Path | None, stdin: str, timeout: float
    ) -> subprocess.CompletedProcess[str]:
        """Run the program in a folder; return exit code and output. After ``timeout`` s it is terminated."""
        with contextlib.ExitStack() as files:
            streams = [files.enter_context(tempfile.TemporaryFile("w+")) for _ in range(3)]
            streams[0].write(stdin)
            streams[0].seek(0)
            code = called(self.address(), arguments, os.fspath(cwd or os.getcwd()), streams, timeout)
            for stream in streams[1:]:
                stream.seek(0)
            return subprocess.CompletedProcess(arguments, code, *(stream.read() for stream in streams[1:]))


def called(address: str, arguments: list[str], cwd: str, streams: Sequence[IO[str]], timeout: float) -> int:
    """Make the server run the program with these standard streams; return its exit code."""
    call = {"arguments": arguments, "cwd": cwd, "s": timeout, "environment": dict(os.environ)}
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(address)
        socket.send_fds(server, [f"{json.dumps(call)}\n".encode()], [stream.fileno() for stream in streams])
        return os.waitstatus_to_exitcode(int(server.recv(MOST_BYTES)))


def serve(address: str) -> None:
    """Fork the program for each call and send its status back."""
    for name in LAZY:
        importlib.import_module(name)
    package = importlib.import_module("virest")
    for module in pkgutil.walk_packages(package.__path__, "virest."):
        if not module.name.endswith("__main__"):
            with contextlib.suppress(ImportError):
                importlib.import_module(module.name)
    importlib.import_module("virest.app.cli").program()
    gc.freeze()
    with socket.socket(socket.AF_UNIX) as calls:
        calls.bind(address)
        calls.listen()
        print("ready", flush=True)
        while calls in select.select([calls, sys.stdin], [], [])[0]:
            answer(calls.accept()[0])


def answer(connection: socket.socket) -> None:
    """Fork the program for one call, wait for it, and send its status back."""
    with connection:
        text, streams, _, _ = socket.recv_fds(connection, MOST_BYTES, 3)
        while not text.endswith(b"\n"):
            text += connection.recv(MOST_BYTES)
        call = json.loads(text)
        child = os.fork()
        if not child:
            signal.alarm(int(call["s"]))
            os.environ.clear()
            os.environ.update(call["environment"])
            become(call["arguments"], call["cwd"], streams)
        for stream in streams:
            os.close(stream)
        connection.sendall(str(os.waitpid(child, 0)[1]).encode())


def become(arguments: list[str], cwd: str, streams: Sequence[int]) -> NoReturn:
    """Turn the forked process into the program."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(cwd)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
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
    """End as the interpreter does, without the tenth of a second for clearing modules.

    Exceptions of libraries at exit are ignored, as in the interpreter: executors of 3.11 may wake a closed pipe.
    """
    with contextlib.suppress(OSError):
        threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    task, address, *arguments = sys.argv[1:]
    if task == "serve":
        serve(address)
    else:
        sys.exit(called(address, arguments, os.getcwd(), (sys.stdin, sys.stdout, sys.stderr), LONGEST_S))
