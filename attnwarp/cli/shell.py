"""Exit of every command: exit codes, one-line errors, Ctrl-C; and its number of threads."""

from __future__ import annotations

import json
import os
import shlex
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from attnwarp import process
from attnwarp.cli.entry import STOPPED
from attnwarp.errors import InputError, InputWarning, missing_extra
from attnwarp.process import (
    core_count,
    skip_last_collection,
    stops_interrupt,
)

USAGE = 2
"""Exit code of errors that the user can fix: arguments, files, folders."""


CLOSED_PIPE = 141
"""Exit code after the reader closes the output (128 + SIGPIPE, as in shells)."""


CRASH = 70
"""Exit code of an internal error, as in sysexits. Python's code 1 means a regression here."""

NOTHING = "stopped; nothing was written"


_program = "attnwarp"
_printed: dict[str, None] = {}
_stop_told = False
"""True once a line has told that the command was stopped."""


def begin(name: str) -> None:
    """Set the command name, the prefix of all messages."""
    global _program, _stop_told
    _program, _stop_told = name, False
    _printed.clear()


def fail(message: str, code: int = USAGE) -> typer.Exit:
    """Print an error on stderr; the caller raises the returned exception."""
    global _stop_told
    _stop_told = _stop_told or code == STOPPED
    log(message)
    return typer.Exit(code)


def log(message: str) -> None:
    """Print a line on stderr, prefixed by the command's name."""
    typer.echo(f"{_program}: {message}", err=True)


def warn(text: str) -> None:
    """Print a warning on stderr, once per command, since inputs are read repeatedly."""
    if text not in _printed:
        _printed[text] = None
        log(f"warning: {text}")


def warned() -> list[str]:
    """List the command's warnings so far, in order."""
    return [*_printed]


@contextmanager
def clear_errors(
    stopped: str = NOTHING, out: Path | None = None, *, strict: bool = False
) -> Iterator[None]:
    """Turn errors about the user's input into one clear line and exit code 2.

    Args:
        stopped: message after Ctrl-C, SIGTERM or SIGHUP.
        out: folder of the results mentioned in ``stopped``, if any; while it does not exist,
            nothing was written.
        strict: True lets all errors but InputError propagate as internal errors, and shows Python's
            warnings.
    """
    show_others = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, InputWarning):
            warn(str(message))
        elif strict:
            show_others(message, category, *rest, **more)

    try:
        with stops_interrupt(), warnings.catch_warnings():
            if not strict:
                warnings.simplefilter("always", InputWarning)
            warnings.showwarning = show
            yield
    except typer.Exit:  # a subclass of RuntimeError
        raise
    except KeyboardInterrupt:
        raise fail(stopped if out is None or out.exists() else NOTHING, STOPPED) from None
    except BrokenPipeError:
        raise closed_pipe() from None
    except InputError as error:
        raise fail(str(error)) from None
    except MemoryError:
        raise fail("the memory does not suffice; use smaller pictures or fewer splats") from None
    except OSError as error:
        raise fail(file_error(error)) from None
    except ImportError as error:
        if strict or process.interrupted:
            raise
        package = error.name or str(error)
        raise fail(f"needs the package {package}: pip install {package.split('.')[0]}") from None
    except (ValueError, RuntimeError) as error:
        loop = "Symlink loop" in str(error)  # raised by Path.resolve() before Python 3.13
        if strict and not loop:
            raise
        raise fail(f"{error}; name another path" if loop else str(error)) from None


def file_error(error: OSError) -> str:
    """Describe a file error of the system in one line, with a remedy."""
    text = str(error)
    if isinstance(error, TimeoutError | ConnectionError) and not error.filename:  # such as dask's
        text = f"{type(error).__name__}: {text}".removesuffix(": ")
        return f"a connection between processes failed ({text}); run the same command again"
    if error.strerror is None:  # the library's error, which includes a remedy
        return text
    name = f"{error.filename}: " if error.filename else ""
    if isinstance(error, FileExistsError) and Path(error.filename or "").is_symlink():
        target = Path(error.filename).readlink()
        return f"{name}is a link to {target}, which is not there; make that, or remove the link"
    return f"{name}{error.strerror}; check the path, the space on its disk and its permissions"


def closed_pipe() -> typer.Exit:
    """Discard unflushed output, since its reader has closed the pipe."""
    with suppress(OSError, ValueError):  # not a real stream, as under a test runner
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return typer.Exit(CLOSED_PIPE)


def check_out(out: Path) -> None:
    """Check --out before the work, so that an error appears early; the folder is created with the
    first result.
    """
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(
            f"{out}: --out is a file, expected a folder (made if need be); choose another name"
        )


COMMANDS = {
    "attnwarp": ("poses", "fit", "edit", "render", "convert", "undistort", "edit-image"),
    "attnwarp-eval": (
        "run", "report", "bench", "verdicts", "verify", "studies", "captures", "compare",
        "stability", "metrics", "tracks", "encoders", "doctor", "scenes", "userstudy", "cache",
    ),
}  # fmt: skip
"""Commands available in only one of the two programs."""


class _Plain:
    """Help in plain text with a section for each panel. Typer would draw it by rich, whose import
    takes as long as all else that answers ``--help``.
    """

    def get_params(self: Any, ctx: Any) -> list[Any]:
        """Return the options, flags without the type <bool>, since they take no value."""
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            if getattr(param, "is_flag", False):
                param.metavar = ""
            if param.name in ("help", "install_completion", "show_completion"):
                param.default = False  # typer would import pydantic to read None
        return params

    def format_options(self: Any, ctx: Any, formatter: Any) -> None:
        """Write the sections of arguments, options and commands."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            panel = "Arguments" if param.param_type_name == "argument" else "Options"
            row = param.get_help_record(ctx)
            if row is not None:
                sections.setdefault(getattr(param, "rich_help_panel", None) or panel, []).append(
                    row
                )
        for name, command in getattr(self, "commands", {}).items():
            if not command.hidden:
                first, *_ = (command.help or "").split("\n\n")
                sections.setdefault(command.rich_help_panel or "Commands", []).append((name, first))
        for name, rows in sections.items():
            with formatter.section(name):
                formatter.write_dl(rows)


class Command(_Plain, TyperCommand):
    """A command of a program."""


class Program(_Plain, TyperGroup):
    """Commands of a program; a command of the other program gets a hint."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command named by the first argument."""
        for name, commands in COMMANDS.items():
            if args[0] in commands and args[0] not in self.commands:
                raise fail(f"{args[0]} is a command of {name}: {shlex.join([name, *args])}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the named command; a refused choice is told without pydantic's first words."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise


class App(typer.Typer):
    """Commands by name, whose help is plain text."""

    def __init__(self, **more: Any) -> None:
        super().__init__(cls=Program, rich_markup_mode=None, pretty_exceptions_enable=False, **more)

    def command(self, name: str | None = None, **more: Any) -> Any:
        """Decorate the function of a command."""
        return super().command(name, cls=Command, **more)


def use_threads(threads: int | None) -> None:
    """Set the threads of the renderer and of torch. Splats fitted without an exposure have the same
    bits for any number.
    """
    import cv2
    import torch

    from attnwarp.render.threads import set_thread_count

    count = threads or core_count()
    torch.set_num_threads(count)
    cv2.setNumThreads(1)
    set_thread_count(count)


def assignments(changes: list[str], options: dict[str, str]) -> dict[str, Any]:
    """Parse NAME=VALUE with JSON values; a bare word is text."""
    values: dict[str, Any] = {}
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals or not name:
            raise ValueError(f"--set: got {change!r}, expected NAME=VALUE such as --set ssim=0.3")
        if name in options:
            raise ValueError(f"--set: {name} has an option of its own, {options[name]}")
        try:
            values[name] = json.loads(text)
        except ValueError:
            values[name] = text
    return values


def run(app: typer.Typer, name: str) -> None:
    """Run a command line to its exit code: the entry point of both programs."""
    skip_last_collection()
    begin(name)
    try:
        try:
            app(prog_name=name)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        sys.exit(closed_pipe().exit_code)
    except OSError as error:  # unwritable output
        closed_pipe()
        sys.exit(fail(file_error(error)).exit_code)
    except SystemExit as done:
        if done.code == STOPPED and not _stop_told:
            # Typer's exit after Ctrl-C where a command does not look out for it: while it imports.
            log("stopped")
        # Typer's code for a closed pipe is 1; a regression has a separate exception type.
        sys.exit(CLOSED_PIPE if done.code == 1 and type(done) is SystemExit else done.code)
    except Exception as error:
        if process.interrupted:
            sys.exit(fail(NOTHING, STOPPED).exit_code)
        explained = missing_extra(error) if isinstance(error, ImportError) else None
        if explained is None:
            traceback.print_exc()
            sys.exit(CRASH)
        sys.exit(fail(str(explained)).exit_code)
