"""Base of settings: frozen dataclasses whose annotations define each field's valid values."""

from __future__ import annotations

import functools
import math
import types
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from attnwarp import check

S = TypeVar("S", bound="Settings")


@dataclass(frozen=True)
class Range:
    """Limits of a number, both included."""

    low: float = 0.0
    high: float = math.inf


Share = Annotated[float, Range(0, 1)]
Weight = Annotated[float, Range(0)]
Count = Annotated[int, Range(1)]
Number = Annotated[int, Range(0)]
Seed = Annotated[int, Range(0, 2**62)]


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


class Settings:
    """Base class that checks each field against its annotation when an instance is created.

    ``Literal`` lists choices, ``Annotated[int, Range(1)]`` has limits, ``X | None`` accepts None, a
    tuple accepts a list, and other settings accept a dictionary. Numbers of numpy become Python
    numbers.

    Raises:
        ValueError: a value violates its annotation; the message names the field.

    Example:
        >>> from dataclasses import dataclass
        >>> from attnwarp.settings import Count, Settings
        >>> @dataclass(frozen=True)
        ... class Steps(Settings):
        ...     steps: Count = 20
        >>> Steps().changed(steps=2).to_dict()
        {'steps': 2}
        >>> Steps(steps=0)
        Traceback (most recent call last):
        ValueError: steps: got 0, expected a whole number >= 1
    """

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():  # type: ignore[arg-type]
            object.__setattr__(self, name, _checked(getattr(self, name), hint, name))

    def to_dict(self) -> dict[str, Any]:
        """Convert to JSON values in field order; equal settings give equal dictionaries."""
        values = asdict(self)  # type: ignore[call-overload]
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    @classmethod
    def from_dict(cls: type[S], data: dict[str, Any]) -> S:
        """Restore settings from the result of :meth:`to_dict`; missing fields take their default.

        Raises:
            ValueError: a key is not a field, or a value is out of range.
        """
        _check_names(cls, data)
        return cls(**data)

    def changed(self: S, **changes: Any) -> S:
        """Copy the settings with some fields changed.

        Args:
            changes: fields by name. For a field that holds settings itself, a dictionary changes
                the fields it names and keeps the others, as ``**{"field.name": value}`` does.

        Raises:
            ValueError: a field is unknown, or a value is out of range; the message names the field.
        """
        values: dict[str, Any] = {}
        for key, value in changes.items():
            name, dot, inner = key.partition(".")
            _check_names(type(self), [name])
            before = values.get(name, getattr(self, name))
            change = {inner: value} if dot else value
            if isinstance(change, dict) and isinstance(before, Settings):
                values[name] = before.changed(**{str(k): v for k, v in change.items()})
            elif dot:
                raise ValueError(f"{name}: got {before!r}, expected its fields by name")
            else:
                values[name] = change
        return replace(self, **values)  # type: ignore[type-var]


def _check_names(kind: Any, data: Iterable[str]) -> None:
    for name in data:
        check.one_of(name, [field.name for field in fields(kind)], "setting")


def _checked(value: Any, hint: Any, name: str) -> Any:
    """Convert ``value`` to the type of its annotation."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        (hint,) = (part for part in arguments if part is not type(None))
        return _checked(value, hint, name)
    if origin is Annotated:
        (kind, limits) = arguments
        value = check.number(value, limits.low, limits.high, name, whole=kind is int)
        return value if kind is int else float(value)
    if origin is Literal:
        return check.one_of(value, arguments, name)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{name}: got {value!r}, expected a list")
        # Numbers of numpy are not JSON-serialisable.
        return tuple(v.item() if isinstance(v, np.generic) else v for v in value)
    if hint is bool:
        if not isinstance(value, bool):
            raise ValueError(f"{name}: got {value!r}, expected true or false")
    elif hint is str:
        check.text(value, name)
    elif isinstance(hint, type) and issubclass(hint, Settings):
        if isinstance(value, dict):
            return hint.from_dict(value)
        if not isinstance(value, hint):
            raise ValueError(f"{name}: got {value!r}, expected {hint.__name__}")
    return value
