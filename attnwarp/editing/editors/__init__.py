"""Editors, one per file: a class with the decorator :func:`reads` is found by its pipelines'
folders (docs/project/extending.md).
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
    """Register a class whose ``from_folder`` reads folders of these diffusers pipelines, named in
    their model_index.json.
    """

    def register(kind: K) -> K:
        _kinds.update(dict.fromkeys(pipelines, kind))
        return kind

    return register


@cache
def kinds() -> Mapping[str, type[Any]]:
    """Map each pipeline to the editor class that reads its folders."""
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    return _kinds
