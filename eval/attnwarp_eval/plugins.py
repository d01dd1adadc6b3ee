"""Probes and editing methods of other packages, which register themselves on import."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from attnwarp.errors import InputError
from attnwarp_eval.cost import count_plugin

GROUP = "attnwarp_eval"
"""Group of entry points: each names a module of an installed package, such as the laboratory."""

VARIABLE = "ATTNWARP_PLUGINS"
"""Environment variable: modules to import too, by commas. Local workers inherit it."""


@cache
def load_plugins() -> None:
    """Import every plugin, once per process.

    Raises:
        InputError: a plugin cannot be imported; the message says where it is named.
    """
    for module, named_by in _named():
        try:
            imported = importlib.import_module(module)
        except (Exception, SystemExit) as error:
            raise InputError(
                f"{named_by}: the plugin {module!r} cannot be imported:"
                f" {type(error).__name__}: {' '.join(str(error).split())}"
            ) from error
        package = sys.modules[module.partition(".")[0]]
        file = package.__file__ or imported.__file__  # none of a namespace
        if file is not None and file.endswith(".py"):
            count_plugin(module, Path(file))


def plugin_modules() -> list[str]:
    """Modules of the configured plugins, sorted."""
    return sorted({module for module, _ in _named()})


def plugin_folders(name: str) -> list[Path]:
    """Paths of a folder in each plugin's package; they may not exist."""
    load_plugins()
    packages = sorted({module.partition(".")[0] for module in plugin_modules()})
    paths = (path for each in packages for path in getattr(sys.modules[each], "__path__", ()))
    return [Path(path) / name for path in paths]


def _named() -> Iterator[tuple[str, str]]:
    """Module names, each with its origin."""
    for entry in entry_points(group=GROUP):
        package = entry.dist.name if entry.dist else "a package"
        yield entry.module, f"entry point {entry.name!r} of {package}"
    for module in filter(None, map(str.strip, os.environ.get(VARIABLE, "").split(","))):
        yield module, VARIABLE
