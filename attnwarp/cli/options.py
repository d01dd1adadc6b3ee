"""What a person may type, of which several commands have some."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Kind(StrEnum):
    """What a person may type for the kind of splats."""

    two = "2dgs"
    three = "3dgs"


class Format(StrEnum):
    """What a person may type for the format of a data set."""

    transforms = "transforms"
    colmap = "colmap"


class MissingImages(StrEnum):
    """What a person may type for what happens to cameras without a picture."""

    error = "error"
    none = "none"


class Store(StrEnum):
    """What a person may type for the place of recorded features."""

    cpu = "cpu"
    device = "device"
    disk = "disk"


class Coordinates(StrEnum):
    """What a person may type for the coordinates in a file of splats."""

    auto = "auto"
    world = "world"
    relative = "relative"


DataArgument = Annotated[
    Path, typer.Argument(help="transforms.json, its folder, or a COLMAP folder, with images.")
]


MaxSizeOption = Annotated[
    int | None, typer.Option(min=16, help="Shrink larger images to this many px.")
]


FormatOption = Annotated[
    Format | None, typer.Option(help="What DATA is, where its folder holds both formats.")
]


ImagesOption = Annotated[Path | None, typer.Option(help="Folder of the images of a COLMAP model.")]


ResizeOption = Annotated[
    bool, typer.Option("--resize-cameras", help="Fit cameras to images of another size.")
]


IgnoreOption = Annotated[
    list[str] | None,
    typer.Option(
        "--ignore-key", metavar="KEY", help="Pass over this key of a transforms.json (mask_path)."
    ),
]


MissingOption = Annotated[
    MissingImages, typer.Option(help="none: leave out cameras whose image is not there.")
]


SplatKindOption = Annotated[
    Kind | None, typer.Option(help="Read the file as this kind, whatever it says of itself.")
]


AntialiasedOption = Annotated[
    bool | None,
    typer.Option(
        "--antialiased/--no-antialiased",
        help="Whether the splats were fitted antialiased, whatever the file says.",
    ),
]
