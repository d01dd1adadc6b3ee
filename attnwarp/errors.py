"""Errors and warnings about user input: the command line prints their message, and exits with
code 2 after an error.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

V = TypeVar("V")


@dataclass(frozen=True)
class Extra:
    """Optional dependency group (extra) of pyproject.toml.

    Attributes:
        modules: modules that only the extra installs.
        lack: consequence of a missing extra.
    """

    modules: tuple[str, ...]
    lack: str


EXTRAS = {
    "edit": Extra(
        ("diffusers", "tokenizers", "transformers"),
        "no diffusion editor and no mask by words; warps, masks and depth are measured",
    ),
    "eval": Extra(
        (
            "dask", "distributed", "drjit", "jinja2", "mapbox_earcut", "markupsafe", "matplotlib",
            "mitsuba", "mpmath", "open3d", "pydantic", "skimage", "yaml",
        ),
        "nothing of attnwarp-eval runs",
    ),
    "inspect": Extra(
        ("pyvista",), "no window of a warp in 3D; reports have their pictures"
    ),
    "web": Extra(("trame", "trame_vtk", "trame_vuetify"), "no warp in 3D in a browser"),
    "gpu": Extra(
        ("accelerate", "warp"),
        "splats are rendered on the processor, and --low-memory is refused",
    ),
    "formats": Extra(("gaussforge",), "no splats of SPZ, SOG, KSPLAT and compressed PLY"),
    "colmap": Extra(("pycolmap",), "no poses of photographs, no tracks, no figures by COLMAP"),
}  # fmt: skip
"""All extras, by their names in pyproject.toml."""


def install_command(*extras: str) -> str:
    """Write the command that installs extras, into a checkout or next to an installed wheel.

    Example:
        >>> print(install_command("edit", "eval"))
        in the checkout: pip install -c constraints.txt -e '.[edit,eval]'
    """
    names = ",".join(extras)
    if (Path(__file__).parents[1] / "pyproject.toml").is_file():
        return f"in the checkout: pip install -c constraints.txt -e '.[{names}]'"
    return f"pip install 'attnwarp[{names}]'"


class InputError(ValueError):
    """Error for an unusable input. The message names the file, its value, the expectation and the
    remedy.
    """


class MissingExtraError(InputError):
    """Error for a package that is not installed, since it belongs to an extra. The message names
    the extra."""

    def __init__(self, module: str, extra: str) -> None:
        super().__init__(
            f"needs the package {module}, which comes with the extra {extra!r};"
            f" {install_command(extra)}"
        )
        self.module = module
        self.extra = extra


def missing_extra(error: ImportError) -> MissingExtraError | None:
    """Convert a failed import into the error to show; None if no extra has the module."""
    module = (error.name or "").partition(".")[0]
    extra = next((name for name, extra in EXTRAS.items() if module in extra.modules), None)
    if extra is None or not isinstance(error, ModuleNotFoundError):
        return None
    return MissingExtraError(module, extra)


@contextmanager
def optional_imports() -> Iterator[None]:
    """Wrap imports of an extra's packages, so that the error for a missing one names the extra.

    Raises:
        MissingExtraError: the package is not installed.

    Example:
        >>> with optional_imports():
        ...     import numpy
    """
    try:
        yield
    except ModuleNotFoundError as error:
        explained = missing_extra(error)
        if explained is None:
            raise
        raise explained from error


class InputWarning(UserWarning):
    """Warning for an input that is used, though perhaps not as intended. The message names the
    file, and the ignored or changed part.
    """


class Named(dict[str, V]):
    """Dictionary whose error for an unknown name lists the known names and the nearest.

    Example:
        >>> Named(corrected=1, paper=2)["correct"]
        Traceback (most recent call last):
        KeyError: "got 'correct', expected one of 'corrected', 'paper'; did you mean 'corrected'?"
    """

    def __missing__(self, name: Any) -> V:
        listed = ", ".join(map(repr, self))
        hint = suggest(str(name), list(self))
        raise KeyError(f"got {name!r}, expected one of {listed}{hint}")


def suggest(word: str, allowed: Sequence[str]) -> str:
    """Write a message's end with the allowed word nearest to a misspelt one; empty if none is near.

    Example:
        >>> suggest("lr_mean", ["lr_means", "ssim"])
        "; did you mean 'lr_means'?"
    """
    near = nearest(word, allowed)
    return "" if near is None else f"; did you mean {near!r}?"


def nearest(word: str, allowed: Sequence[str]) -> str | None:
    """Find the allowed word nearest to a misspelt one; None if none is near."""
    return next(iter(difflib.get_close_matches(word, allowed, n=1)), None)
