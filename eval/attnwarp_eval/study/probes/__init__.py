"""The probes, one file each; other code finds them here by name.

>>> [probe.name for probe in probes()]
['calibration', 'depth', 'editing', 'editing-timing', 'fit', 'sensitivity', 'stability', 'timing',
 'variability', 'warp']
>>> probe("depth").columns["AbsRel"]
'depth.abs_rel'
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Any, TypeVar

from attnwarp_eval.study.plugins import load_plugins
from attnwarp_eval.study.probes.base import Probe

K = TypeVar("K", bound=type[Probe[Any]])

_registered: dict[str, Probe[Any]] = {}


def register(kind: K) -> K:
    """Class decorator: make a probe available under its name.

    Raises:
        ValueError: another class has that name.
    """
    other = _registered.get(kind.name)
    if other is not None and type(other) is not kind:
        raise ValueError(f"probe {kind.name!r}: {type(other).__qualname__} has that name already")
    _registered[kind.name] = kind()
    return kind


def unregister(name: str) -> None:
    """Take back :func:`register`."""
    _registered.pop(name, None)


@cache
def _discover() -> None:
    for module in sorted(m.name for m in pkgutil.iter_modules(__path__)):
        importlib.import_module(f"{__name__}.{module}")
    load_plugins()


def probes() -> list[Probe[Any]]:
    """Every probe: those of this folder by their names, then those registered elsewhere."""
    _discover()
    own = {name: p for name, p in _registered.items() if type(p).__module__.startswith(__name__)}
    return [
        *(own[name] for name in sorted(own)),
        *(p for p in _registered.values() if p.name not in own),
    ]


def probe(name: str) -> Probe[Any]:
    """The probe of a name. KeyError: there is none."""
    _discover()
    return _registered[name]
