"""Options shared by several commands."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from attnwarp import __version__
from attnwarp.cli.shell import begin

if TYPE_CHECKING:
    from attnwarp.command.edit import EditOptions
    from attnwarp.command.marks import Marks

Kind = Literal["2dgs", "3dgs"]
"""Kinds of splats, as commands name them."""

PANELS = (
    "The mark", "The method", "Splats", "The page", "The machine", "Reading DATA",
)  # fmt: skip
"""Panels of the help in order, below the panel of common options."""

LONGEST_EDIT = 4096
"""Longest side of an edit; a larger value is a typing error that would exhaust the memory."""

SEGMENTER = "clip-parts"
"""Segmenter of ``--where`` if ``--segmenter`` is omitted."""


def option(
    text: str, metavar: str | None = None, *names: str, panel: str | None = None, **more: Any
) -> Any:
    """Describe an option of a command.

    Args:
        names: spellings, such as "--set"; that of the argument if omitted.
        more: further keywords of :func:`typer.Option`.
    """
    return typer.Option(*names, help=text, metavar=metavar, rich_help_panel=panel, **more)


of_marking, of_method, of_splats, of_page, of_machine, of_reading = (
    functools.partial(option, panel=panel) for panel in PANELS
)

InstructionOption = Annotated[str, option('Say what to change, such as "make it red".')]

AnywayOption = Annotated[
    bool,
    option(
        "Edit even if the words name no look that a bundled editor knows, or nothing in a bundled"
        " scene, which is then edited as a whole.",
        None,
        "--anyway",
        panel=PANELS[1],
    ),
]

EditorOption = Annotated[
    str,
    option(
        "Edit by this editor: a bundled one, small-plain, small-parts or small-depth, or a"
        " folder in diffusers' format; two folders, BASE,CONTROLNET, edit by depth.",
        "NAME|FOLDER",
    ),
]

WhereOption = Annotated[
    str | None,
    option('Edit only what these words name in the picture, such as "bear".', "WORDS", "--where"),
]

BoxOption = Annotated[
    str | None,
    option(
        "Edit only the thing in this box: px of the source view's file, from its top left corner.",
        "X0,Y0,X1,Y1",
    ),
]

AtOption = Annotated[
    str | None,
    option(
        "Edit only the thing at this point: px of the picture's file, from its top left corner.",
        "X,Y",
    ),
]

SegmenterOption = Annotated[
    str | None,
    of_marking(
        "Let this segmenter find the words of --where: clip-parts (default), or the folders of"
        " Grounding DINO and SAM, DINO,SAM.",
        "NAME",
    ),
]

ThreadsOption = Annotated[
    int | None, of_machine("Use so many CPU threads (default: all cores).", "N", min=1)
]

DeviceOption = Annotated[
    str, of_machine("Compute on cpu, cuda, or auto: a GPU if there is one.", "NAME")
]

DtypeOption = Annotated[
    str,
    of_machine(
        "Compute the editor in float32, float16, bfloat16 (whose pictures differ ten times as"
        " much), or auto: float32 on a CPU; on a GPU bfloat16 for FLUX, Qwen and Stable Diffusion"
        " 3, else float16.",
        "TYPE",
    ),
]

LowMemoryOption = Annotated[
    bool,
    of_machine(
        "Keep the editor's weights in main memory until they are needed, and decode pictures in"
        " tiles: slower, for a GPU too small for the editor.",
        None,
        "--low-memory",
    ),
]

DataArgument = Annotated[
    Path,
    typer.Argument(
        help="Posed pictures: a transforms.json, its folder, or a folder of COLMAP or BlendedMVS."
    ),
]


MaxSizeOption = Annotated[
    int | None,
    of_reading("Shrink pictures whose longest side exceeds so many px to that size.", "N", min=16),
]


SplatKindOption = Annotated[
    Kind | None, of_splats("Read the splats as 2dgs or 3dgs, whatever their file says.")
]


ScreenFilterOption = Annotated[
    float | None,
    of_splats(
        "Add this variance to the splats on the screen, in square px: 0.3 as 3DGS, 0.1 as"
        " Mip-Splatting (default: what their file says, else 0.3).",
        "PX2",
    ),
]


AntialiasedOption = Annotated[
    bool | None,
    of_splats(
        "Render 3DGS with or without opacity compensation, as the splats were fitted (default: what"
        " their file says, else without).",
        None,
        "--antialiased/--no-antialiased",
    ),
]


@dataclass(frozen=True)
class Reading:
    """Options of reading a dataset: one per keyword of `attnwarp.io.read_dataset`."""

    format: Annotated[
        Literal["transforms", "colmap"] | None,
        of_reading("Read this format if DATA holds both."),
    ] = None
    images: Annotated[
        Path | None, of_reading("Read the pictures of a COLMAP model from this folder.", "FOLDER")
    ] = None
    scale: Annotated[
        int,
        of_reading(
            "Read the pictures of the folder images_N, which are so many times smaller: 2, 4 or 8.",
            "N",
        ),
    ] = 1
    missing_images: Annotated[
        Literal["error", "none"],
        of_reading("Stop at a camera whose picture is missing (error), or leave it out (none)."),
    ] = "error"
    resize_cameras: Annotated[
        bool,
        of_reading(
            "Resize cameras to pictures of another size, which are refused otherwise.",
            None,
            "--resize-cameras",
        ),
    ] = False
    ignore_keys: Annotated[
        list[str] | None,
        of_reading(
            "Pass over this key of a transforms.json; may be repeated.", "KEY", "--ignore-key"
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
        option(
            "Mark and edit this view first, by its name or number (default: the first that is not"
            " held out).",
            "VIEW",
        ),
    ] = None
    at: Annotated[
        list[str] | None,
        option(
            "Edit only the thing at this point: px of the picture's file, from its top left corner;"
            " given again, it adds the thing, or the part, at another point.",
            "X,Y",
        ),
    ] = None
    box: BoxOption = None
    words: WhereOption = None
    mask: Annotated[
        Path | None,
        option(
            "Edit only what is white in this mask of the source view, lifted into all views.",
            "FILE",
        ),
    ] = None
    masks: Annotated[
        Path | None,
        option("Edit only what is white in these masks: a NAME.png for each view.", "FOLDER"),
    ] = None
    segmenter: SegmenterOption = None

    def marks(self) -> Marks:
        """Build the marks."""
        check_segmenter(self.segmenter, self.words)
        from attnwarp.command.marks import Marks, numbers, points

        return Marks(
            self.masks, self.mask, numbers(self.box, "X0,Y0,X1,Y1", "--box"),
            points(self.at, "--at"), self.words, self.segmenter or SEGMENTER,
        )  # fmt: skip


@dataclass(frozen=True)
class Editing(Marking):
    """Options of editing a scene by any method."""

    tune_outside: Annotated[
        bool,
        of_marking(
            "Tune all splats, also those that no mask marks, which stay as they are otherwise.",
            None,
            "--tune-outside",
        ),
    ] = False
    max_size: MaxSizeOption = None
    device: DeviceOption = "auto"
    dtype: DtypeOption = "auto"
    low_memory: LowMemoryOption = False
    threads: ThreadsOption = None
    control: Annotated[
        bool | None,
        of_page(
            "Also edit each view of the page alone, for comparison (default: only with a bundled"
            " editor).",
            None,
            "--control/--no-control",
        ),
    ] = None
    turntable: Annotated[
        Path | None,
        of_page("Write a film of the scene's turn, before and after: .gif or .mp4.", "FILE"),
    ] = None

    def checked(self) -> EditOptions:
        """Check the options and convert them for an edit."""
        from attnwarp.command.edit import EditOptions

        own = {field.name for field in fields(EditOptions)} - {"marks"}
        return EditOptions(self.marks(), **{name: getattr(self, name) for name in own})


def options_of(
    *groups: type[Any], without: str | None = None
) -> Callable[[Callable[..., None]], Any]:
    """Replace a command's dataclass arguments by one option for each field.

    Typer reads a command's options from its signature, so the fields are added there.

    Args:
        groups: dataclass by argument name: `Reading` for ``reading``, `Editing` for ``editing``.
        without: name of a field that is no option of this command and keeps its default.
    """
    own_options = {
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
                for group, options in own_options.items()
            }
            command(**values, **made)

        signature = inspect.signature(command, eval_str=True)
        own = [p for p in signature.parameters.values() if p.name not in names.values()]
        options = [*own, *(option for group in groups for option in own_options[group])]
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
        option(
            "Show the version, and exit.", None, "--version", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Options without a command, of either program."""
    begin(str(context.info_name))
