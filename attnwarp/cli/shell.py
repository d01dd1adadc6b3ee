"""How every command ends: exit codes, errors as one line, Ctrl-C; and the threads that it uses."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import typer

from attnwarp.cli.entry import STOPPED
from attnwarp.errors import InputWarning
from attnwarp.process import core_count, stops_interrupt

USAGE = 2
"""Exit code of everything that a person can mend: arguments, files, folders."""


CLOSED_PIPE = 141
"""Exit code when nobody reads the output any more (128 + SIGPIPE, as shells have it)."""


def fail(message: str) -> typer.Exit:
    """Say what went wrong on stderr; raise what this returns."""
    typer.echo(f"attnwarp: {message}", err=True)
    return typer.Exit(USAGE)


def echo(text: str) -> None:
    """Say something on stderr."""
    typer.echo(text, err=True)


NOTHING = "stopped; nothing was written"


@contextmanager
def clear_errors(stopped: str = NOTHING, out: Path | None = None) -> Iterator[None]:
    """Turn errors about a person's input into one clear line and exit code 2.

    Args:
        stopped: what is said after Ctrl-C, a polite kill or the terminal's end.
        out: folder of the results that it speaks of, if it does; nothing was written while it is
            not there.
    """
    printed: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, InputWarning) and str(message) not in printed:
            printed.add(str(message))
            typer.echo(f"attnwarp: warning: {message}", err=True)

    try:
        with stops_interrupt(), warnings.catch_warnings():
            warnings.simplefilter("always", InputWarning)
            warnings.showwarning = show
            yield
    except typer.Exit:  # a RuntimeError too
        raise
    except KeyboardInterrupt:
        said = stopped if out is None or out.exists() else NOTHING
        typer.echo(f"attnwarp: {said}", err=True)
        raise typer.Exit(STOPPED) from None
    except BrokenPipeError:
        raise closed_pipe() from None
    except ImportError as error:
        package = error.name or str(error)
        raise fail(f"needs the package {package}: pip install {package.split('.')[0]}") from None
    except MemoryError:
        raise fail("the memory does not suffice; use smaller pictures or fewer splats") from None
    except (ValueError, RuntimeError) as error:
        raise fail(str(error)) from None
    except OSError as error:
        if error.strerror is None:  # the library's own, which says what to do
            raise fail(str(error)) from None
        raise fail(file_error(error)) from None


def file_error(error: OSError) -> str:
    """One line about a file that the system refused."""
    name = f"{error.filename}: " if error.filename else ""
    if isinstance(error, FileExistsError) and Path(error.filename or "").is_symlink():
        target = Path(error.filename).readlink()
        return f"{name}is a link to {target}, which is not there; make that, or remove the link"
    return f"{name}{error.strerror}; check the path, the space on its disk and its permissions"


def closed_pipe() -> typer.Exit:
    """Let what is still to be flushed go nowhere, as the reader of the output has gone."""
    with suppress(OSError, ValueError):  # no real stream, as under a test's runner
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return typer.Exit(CLOSED_PIPE)


def check_out(out: Path) -> None:
    """A mistaken --out is answered before the work, not after it; the folder is made once there is
    something for it.
    """
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(
            f"{out}: --out is a file, expected a folder (made if need be); choose another name"
        )


def use_threads(threads: int | None) -> None:
    """Threads for the renderer alone: the rest is too small for them, and its bits would depend on
    their number.
    """
    import cv2
    import torch

    from attnwarp.render.threads import set_thread_count

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    set_thread_count(threads or core_count())


def assignments(changes: list[str], options: dict[str, str]) -> dict[str, Any]:
    """NAME=VALUE with JSON values; a bare word is text.

    Args:
        changes: as typed.
        options: names that have an option of their own, and that option.
    """
    values: dict[str, Any] = {}
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals or not name:
            raise ValueError(f"--set: got {change!r}, expected NAME=VALUE such as --set ssim=0.3")
        if name in options:
            raise ValueError(f"--set: {name} has an option of its own, {options[name]}")
        try:
            values[name] = json.loads(text)
        except (ValueError, RecursionError):
            values[name] = text
    return values
