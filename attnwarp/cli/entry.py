"""Beginning and end of both commands: a stop is one line from the first moment to the last."""

from __future__ import annotations

import atexit
import importlib
import os
import signal
import sys
from typing import Any

from attnwarp import process

STOPPED = 130
"""Exit code after Ctrl-C, a polite kill or the terminal's end, as shells have it for Ctrl-C."""


def enter(name: str, module: str) -> None:
    """Import a command and run its ``main``.

    Args:
        name: name of the command, with which its messages begin.
        module: where its ``main`` is.
    """

    def leave(*_: Any) -> None:
        # Not by an exception: where an import, a destructor or the interpreter's end runs, one
        # becomes pages of others.
        os.write(2, f"{name}: stopped; nothing was written\n".encode())
        os._exit(STOPPED)

    before = signal.getsignal(signal.SIGINT)
    heeds = before is signal.default_int_handler  # a shell's background job ignores Ctrl-C
    # Before its import's end, a command has nothing to keep.
    early = [*process.heeded(process.STOPS), *([signal.SIGINT] if heeds else [])]
    for number in early:
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
            # Libraries whose import was cut end the interpreter with codes of their own.
            atexit._run_exitfuncs()
            os._exit(done.code)
        raise
    finally:
        for number in early:
            signal.signal(number, lambda *_: os._exit(STOPPED))


def expanded(argument: str) -> str:
    """An argument with the home folder that it begins with: a shell leaves ``--out=~/x`` alone.

    Example:
        >>> import os
        >>> expanded("--out=~/x") == "--out=" + os.path.expanduser("~/x")
        True
        >>> expanded("--instruction=a ~ bear")
        '--instruction=a ~ bear'
    """
    option, equals, value = "", "", argument
    if argument.startswith("--"):
        option, equals, value = argument.rpartition("=")
    if not value.startswith("~"):
        return argument
    return option + equals + os.path.expanduser(value)  # noqa: PTH111  (keeps a last slash)
