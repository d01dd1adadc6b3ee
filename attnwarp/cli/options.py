"""Options shared by several commands."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from attnwarp import __version__
from attnwarp.cli.shell import begin

if TYPE_CHECKING:
    from attnwarp.methods.command import EditOptions
    from attnwarp.methods.marks import Marks


class Kind(StrEnum):
    """Values of the option ``--kind`` of splats."""

    two = "2dgs"
    three = "3dgs"


class Format(StrEnum):
    """Values of the option for the format of a dataset."""

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


PANELS = (MARKING, METHOD, SPLATS, PAGE, MACHINE, READING) = (
    "What is edited", "The method", "Splats", "The page", "The machine", "Reading DATA",
)  # fmt: skip
"""Panels of the help in order, below the panel of common options."""

MOST_PIXELS = 4096
"""Longest side of an edit; a larger value is a typing error that would exhaust the memory."""

SEGMENTER = "clip-parts"
"""Segmenter of ``--where`` if ``--segmenter`` is omitted."""

InstructionOption = Annotated[str, typer.Option(help='What to change, such as "make it red".')]

AnywayOption = Annotated[
    bool,
    typer.Option(
        "--anyway", help="Take words of which a bundled editor knows none that tells a look."
    ),
]

EditorOption = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="A bundled editor, or a folder in diffusers' format; two, BASE,CONTROLNET, for depth.",
    ),
]

WhereOption = Annotated[
    str | None,
    typer.Option(
        "--where",
        metavar="WORDS",
        help='Names of it, such as "bear"; the rest stays.',
        rich_help_panel=MARKING,
    ),
]

BoxOption = Annotated[
    str | None,
    typer.Option(
        metavar="X0,Y0,X1,Y1",
        help="Box around it, px of the (source) picture.",
        rich_help_panel=MARKING,
    ),
]

AtOption = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y",
        help="Point on it, px of the (source) picture.",
        rich_help_panel=MARKING,
    ),
]

SegmenterOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="What --where asks: clip-parts, or folders DINO,SAM.",
        rich_help_panel=MARKING,
    ),
]

ThreadsOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        metavar="N",
        help="CPU threads; all cores if left out.",
        rich_help_panel=MACHINE,
    ),
]

DeviceOption = Annotated[
    str,
    typer.Option(
        metavar="NAME", help="cpu, cuda, or auto: a GPU if there is one.", rich_help_panel=MACHINE
    ),
]

DtypeOption = Annotated[
    str,
    typer.Option(
        metavar="TYPE",
        help="Of the editor: float32, float16, auto (float16 on a GPU), or bfloat16, which"
        " moves pictures ten times as far.",
        rich_help_panel=MACHINE,
    ),
]

LowMemoryOption = Annotated[
    bool,
    typer.Option(
        "--low-memory",
        help="Weights wait in main memory; pictures are decoded in tiles.",
        rich_help_panel=MACHINE,
    ),
]

DataArgument = Annotated[
    Path, typer.Argument(help="transforms.json, its folder, or a COLMAP folder, with images.")
]


MaxSizeOption = Annotated[
    int | None,
    typer.Option(
        min=16,
        metavar="N",
        help="Shrink larger images to this many px.",
        rich_help_panel=READING,
    ),
]


SplatKindOption = Annotated[
    Kind | None,
    typer.Option(help="Read the file as this kind, whatever it says.", rich_help_panel=SPLATS),
]


ScreenFilterOption = Annotated[
    float | None,
    typer.Option(
        metavar="PX2",
        help="What the screen adds to 3D splats: 0.3 of 3DGS, 0.1 of Mip-Splatting.",
        rich_help_panel=SPLATS,
    ),
]


AntialiasedOption = Annotated[
    bool | None,
    typer.Option(
        "--antialiased/--no-antialiased",
        help="How the splats were fitted.",
        rich_help_panel=SPLATS,
    ),
]


@dataclass(frozen=True)
class Reading:
    """Options of reading a dataset: one per keyword of `attnwarp.io.read_dataset`."""

    format: Annotated[
        Format | None,
        typer.Option(
            metavar="NAME",
            help="transforms or colmap, where DATA holds both.",
            rich_help_panel=READING,
        ),
    ] = None
    images: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Images of a COLMAP model.", rich_help_panel=READING),
    ] = None
    scale: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="2, 4 or 8: images_N in place of images; cameras are resized.",
            rich_help_panel=READING,
        ),
    ] = 1
    missing_images: Annotated[
        MissingImages,
        typer.Option(
            metavar="WHAT",
            help="error, or none: leave out cameras whose image is missing.",
            rich_help_panel=READING,
        ),
    ] = MissingImages.error
    resize_cameras: Annotated[
        bool,
        typer.Option(
            "--resize-cameras",
            help="Fit cameras to images of another size.",
            rich_help_panel=READING,
        ),
    ] = False
    ignore_keys: Annotated[
        list[str] | None,
        typer.Option(
            "--ignore-key",
            metavar="KEY",
            help="Pass over this key of a transforms.json.",
            rich_help_panel=READING,
        ),
    ] = None


def check_segmenter(segmenter: str | None, words: str | None) -> None:
    """Refuse ``--segmenter`` without ``--where``."""
    if segmenter is not None and words is None:
        raise ValueError("--segmenter: needs --where, the words that it looks for")


@dataclass(frozen=True)
class Marking:
    """Options that mark the edited part."""

    source: Annotated[
        str | None,
        typer.Option(
            metavar="VIEW",
            help="Name or number of the view that is marked and edited first.",
            rich_help_panel=MARKING,
        ),
    ] = None
    box: BoxOption = None
    at: AtOption = None
    words: WhereOption = None
    segmenter: SegmenterOption = None
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Mask of the source view, lifted into all; white is edited.",
            rich_help_panel=MARKING,
        ),
    ] = None
    masks: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Masks of all views, NAME.png; white is edited.",
            rich_help_panel=MARKING,
        ),
    ] = None

    def marks(self) -> Marks:
        """Build the marks.

        Raises:
            InputError, ValueError: two kinds of marks are given, or a mark is empty.
        """
        check_segmenter(self.segmenter, self.words)
        from attnwarp.methods.marks import Marks, numbers

        return Marks(
            self.masks, self.mask, numbers(self.box, "X0,Y0,X1,Y1", "--box"),
            numbers(self.at, "X,Y", "--at"), self.words, self.segmenter or SEGMENTER,
        )  # fmt: skip


@dataclass(frozen=True)
class Editing(Marking):
    """Options of editing a scene by any method."""

    tune_outside: Annotated[
        bool,
        typer.Option(
            "--tune-outside",
            help="Tune splats that no mask marks, too.",
            rich_help_panel=MARKING,
        ),
    ] = False
    max_size: MaxSizeOption = None
    device: DeviceOption = "auto"
    dtype: DtypeOption = "auto"
    low_memory: LowMemoryOption = False
    threads: ThreadsOption = None
    control: Annotated[
        bool | None,
        typer.Option(
            "--control/--no-control",
            help="Edit its views each alone too; on with a bundled editor.",
            rich_help_panel=PAGE,
        ),
    ] = None
    turntable: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Film of the scene's turn, before and after: .gif, .mp4.",
            rich_help_panel=PAGE,
        ),
    ] = None

    def checked(self) -> EditOptions:
        """Check the options and convert them for an edit.

        Raises:
            InputError, ValueError: two kinds of marks are given, or a mark is empty.
        """
        from attnwarp.methods.command import EditOptions

        return EditOptions(
            self.marks(), self.tune_outside, self.source, self.max_size, self.device, self.dtype,
            self.low_memory, self.threads, self.control, self.turntable,
        )  # fmt: skip


def options_of(
    *groups: type[Any], without: str | None = None
) -> Callable[[Callable[..., None]], Any]:
    """Replace a command's dataclass arguments by one option for each field.

    Typer reads a command's options from its signature, so the fields are added there.

    Args:
        groups: dataclass by argument name: `Reading` for ``reading``, `Editing` for ``editing``.
        without: name of a field that is no option of this command and keeps its default.
    """
    fields = {
        group: [
            field
            for name, field in inspect.signature(group, eval_str=True).parameters.items()
            if name != without
        ]
        for group in groups
    }
    names = {group: group.__name__.lower() for group in groups}

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def run(**values: Any) -> None:
            made = {
                names[group]: group(**{option.name: values.pop(option.name) for option in options})
                for group, options in fields.items()
            }
            command(**values, **made)

        signature = inspect.signature(command, eval_str=True)
        own = [p for p in signature.parameters.values() if p.name not in names.values()]
        options = [*own, *(option for group in groups for option in fields[group])]
        run.__signature__ = signature.replace(parameters=sorted(options, key=_place))  # type: ignore[attr-defined]
        return run

    return decorate


def _place(option: inspect.Parameter) -> int:
    """Return the position of an option's panel in the help."""
    panel = option.annotation.__metadata__[0].rich_help_panel
    return PANELS.index(panel) if panel in PANELS else -1


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
    begin(str(context.info_name))
