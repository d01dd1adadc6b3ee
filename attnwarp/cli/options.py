"""Options that several commands share."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from attnwarp import __version__
from attnwarp.cli.shell import begin


class Kind(StrEnum):
    """Values of the option for the kind of splats."""

    two = "2dgs"
    three = "3dgs"


class Format(StrEnum):
    """Values of the option for the format of a data set."""

    transforms = "transforms"
    colmap = "colmap"


class MissingImages(StrEnum):
    """Values of the option for cameras without a picture."""

    error = "error"
    none = "none"


class Store(StrEnum):
    """Values of the option for the place of recorded features."""

    cpu = "cpu"
    device = "device"
    disk = "disk"


class Coordinates(StrEnum):
    """Values of the option for the coordinates in a file of splats."""

    auto = "auto"
    world = "world"
    relative = "relative"


DeviceOption = Annotated[
    str, typer.Option(help="cpu, cuda, or auto: a GPU where there is one.", metavar="DEVICE")
]

DtypeOption = Annotated[
    str,
    typer.Option(
        help="Of the editor: float32, float16, bfloat16, or auto: float16 on a GPU.",
        metavar="TYPE",
    ),
]

LowMemoryOption = Annotated[
    bool,
    typer.Option(
        "--low-memory",
        help="Weights wait in main memory, block by block; large pictures are decoded in tiles.",
    ),
]

DataArgument = Annotated[
    Path, typer.Argument(help="transforms.json, its folder, or a COLMAP folder, with images.")
]


MaxSizeOption = Annotated[
    int | None, typer.Option(min=16, help="Shrink larger images to this many px.")
]


RenderThreadsOption = Annotated[
    int | None, typer.Option(min=1, help="CPU threads; all cores if left out.")
]


SplatKindOption = Annotated[
    Kind | None, typer.Option(help="Read the file as this kind, whatever it says of itself.")
]


ScreenFilterOption = Annotated[
    float | None,
    typer.Option(
        help="px^2 that the screen adds to 3D splats, whatever the file says: 0.3 of 3DGS, 0.1 of"
        " Mip-Splatting."
    ),
]


AntialiasedOption = Annotated[
    bool | None,
    typer.Option(
        "--antialiased/--no-antialiased",
        help="Whether the splats were fitted antialiased, whatever the file says.",
    ),
]


@dataclass(frozen=True)
class Reading:
    """Options of reading a data set: the keywords of `attnwarp.io.read_dataset`, each an option."""

    format: Annotated[
        Format | None, typer.Option(help="What DATA is, where its folder holds both formats.")
    ] = None
    images: Annotated[Path | None, typer.Option(help="Folder of the images of a COLMAP model.")] = (
        None
    )
    scale: Annotated[
        int, typer.Option(help="2, 4 or 8: images_N in place of images; cameras are resized.")
    ] = 1
    missing_images: Annotated[
        MissingImages, typer.Option(help="none: leave out cameras whose image is not there.")
    ] = MissingImages.error
    resize_cameras: Annotated[
        bool, typer.Option("--resize-cameras", help="Fit cameras to images of another size.")
    ] = False
    ignore_keys: Annotated[
        list[str] | None,
        typer.Option(
            "--ignore-key",
            metavar="KEY",
            help="Pass over this key of a transforms.json (mask_path).",
        ),
    ] = None


def reading_options(*, without: str | None = None) -> Callable[[Callable[..., None]], Any]:
    """Give a command an option for each field of `Reading`, in place of its argument ``reading``.

    Typer reads a command's options from its signature, so the fields are put there.

    Args:
        without: a field that is no option of this command and keeps its default.
    """
    fields = inspect.signature(Reading, eval_str=True).parameters
    options = [field for name, field in fields.items() if name != without]

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**values: Any) -> None:
            reading = Reading(**{option.name: values.pop(option.name) for option in options})
            command(**values, reading=reading)

        signature = inspect.signature(command, eval_str=True)
        own = [p for p in signature.parameters.values() if p.name != "reading"]
        run.__signature__ = signature.replace(parameters=[*own, *options])  # type: ignore[attr-defined]
        return run

    return decorate


def _print_version(context: typer.Context, asked: bool) -> None:
    if asked:
        typer.echo(f"{context.command.name} {__version__}")
        raise typer.Exit


def program_options(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Options without a command, of either program."""
    begin(str(context.command.name))
