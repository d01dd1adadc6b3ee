"""Entry and exit of both commands: an interruption prints one line at any moment."""

from __future__ import annotations

import atexit
import importlib
import os
import signal
import sys
from typing import Any

STOPPED = 130
"""Exit code after Ctrl-C, SIGTERM or SIGHUP; shells use it for Ctrl-C."""


def enter(name: str, module: str) -> None:
    """Import a command and run its ``main``."""

    def leave(*_: Any) -> None:
        # No exception: raised inside an import, a destructor or the interpreter's shutdown, it
        # would print pages of further errors.
        os.write(2, f"{name}: stopped; nothing was written\n".encode())
        os._exit(STOPPED)

    before = signal.getsignal(signal.SIGINT)
    heeds = before is signal.default_int_handler  # a shell's background job ignores Ctrl-C
    if heeds:
        # A command has nothing to save before its import ends, and Ctrl-C comes early.
        signal.signal(signal.SIGINT, leave)

    from attnwarp import process

    # Read when torch loads OpenMP, whose idle threads else spin: on a busy machine the perceptual
    # distance took 15 times the CPU time on two threads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    process.keep_freed_memory()
    stops = process.heeded(process.STOPS)
    for number in stops:
        signal.signal(number, leave)
    sys.argv[1:] = [expanded(argument) for argument in sys.argv[1:]]
    main = importlib.import_module(module).main
    if heeds:
        signal.signal(signal.SIGINT, process.interrupt)
    try:
        main(name)
    except KeyboardInterrupt:
        leave()
    except SystemExit as done:
        if process.interrupted and isinstance(done.code, int):
            # Libraries with an interrupted import end the interpreter with different exit codes.
            atexit._run_exitfuncs()
            os._exit(done.code)
        raise
    finally:
        for number in [*stops, *([signal.SIGINT] if heeds else [])]:
            signal.signal(number, lambda *_: os._exit(STOPPED))


def expanded(argument: str) -> str:
    """Expand an argument's leading home folder, since a shell leaves ``--out=~/x`` unexpanded."""
    option, equals, value = "", "", argument
    if argument.startswith("--"):
        option, equals, value = argument.rpartition("=")
    if not value.startswith("~"):
        return argument
    return option + equals + os.path.expanduser(value)  # noqa: PTH111  (keeps a trailing slash)
