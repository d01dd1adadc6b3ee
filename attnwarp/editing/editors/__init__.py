"""Editors, one a file: a class with the decorator :func:`reads` is found by the folders that it
reads (docs/project/extending.md).
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, TypeVar

K = TypeVar("K", bound="type[Any]")

_kinds: dict[str, type[Any]] = {}


def reads(*pipelines: str) -> Callable[[K], K]:
    """Class decorator: ``from_folder`` of the class reads folders of these diffusers pipelines, by
    the name in their model_index.json.
    """

    def register(kind: K) -> K:
        _kinds.update(dict.fromkeys(pipelines, kind))
        return kind

    return register


@cache
def kinds() -> Mapping[str, type[Any]]:
    """Classes of editors by the pipelines whose folders they read."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    return _kinds
