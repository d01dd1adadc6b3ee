"""Functions of the methods, made of their classes: all have one signature."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol, TypeVar, Unpack

import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.editing.editor import Editor
from attnwarp.errors import Named
from attnwarp.gaussians import Gaussians
from attnwarp.methods.base import Method, Options, Result, run
from attnwarp.methods.geometry import Warps
from attnwarp.methods.settings import PRESETS, MethodSettings

S = TypeVar("S", bound=MethodSettings, contravariant=True)


class DoorOptions(Options, total=False):
    """Options of all methods, and those of some: a method that has none of them refuses them.

    Args:
        source: number of the view that is edited first.
        warps: see :func:`attnwarp.methods.attention_warping`.
    """

    source: int
    warps: Warps | None


class Door(Protocol[S]):
    """Function of a method; its arguments are those of :func:`attnwarp.methods.by_view`."""

    def __call__(
        self,
        gaussians: Gaussians,
        cameras: Sequence[Camera],
        images: Sequence[npt.NDArray[Any]] | None,
        editor: Editor,
        instruction: str,
        settings: S | None = None,
        **options: Unpack[DoorOptions],
    ) -> Result:
        """Run the method."""
        ...


PUBLIC = "attnwarp.methods"
"""Module from which methods' functions are imported."""

METHODS: Named[Callable[..., Result]] = Named()
"""Methods by name."""


def register(
    name: str, method: Callable[..., Result], presets: Mapping[str, MethodSettings]
) -> None:
    """Name a method and its presets, the default first."""
    METHODS[name], PRESETS[name] = method, Named(presets)


def door(kind: Callable[..., Method], presets: Mapping[str, S]) -> Door[S]:
    """Make and register the function of a method's class, under the name of the class's module.

    Its documentation is that of the class; arguments of the class beside work and settings are
    keywords of the function.
    """
    name = kind.__module__.rpartition(".")[2]
    of_settings = type(next(iter(presets.values())))
    own = list(inspect.signature(kind).parameters.values())[2:]

    def method(*arguments: Any, **options: Any) -> Result:
        given = {part.name: options.pop(part.name) for part in own if part.name in options}
        return run(name, partial(kind, **given), of_settings, *arguments, **options)

    _, *first, settings, options = inspect.signature(Door.__call__).parameters.values()
    parameters = [
        *first,
        settings.replace(annotation=f"{of_settings.__name__} | None"),
        *(part.replace(kind=inspect.Parameter.KEYWORD_ONLY) for part in own),
        options.replace(annotation="Unpack[Options]"),
    ]
    method.__name__ = method.__qualname__ = name
    method.__doc__, method.__module__ = kind.__doc__, PUBLIC
    method.__signature__ = inspect.Signature(parameters, return_annotation="Result")  # type: ignore[attr-defined]
    register(name, method, presets)
    return method
