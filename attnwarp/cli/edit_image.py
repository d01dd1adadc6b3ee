"""Command attnwarp edit-image. Heavy libraries are imported only when it runs."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from attnwarp.cli.options import (
    LONGEST_EDIT,
    SEGMENTER,
    AnywayOption,
    AtOption,
    DeviceOption,
    DtypeOption,
    InstructionOption,
    LowMemoryOption,
    ThreadsOption,
    WhereOption,
    option,
)
from attnwarp.editing.small import bundled, check_words, guide_of, say_foreign
from attnwarp.errors import InputWarning
from attnwarp.process import core_count
from attnwarp.reporting import reporter

if TYPE_CHECKING:
    from attnwarp.editing.editor import Image

PictureEditorOption = Annotated[
    str,
    option(
        "Edit by this editor: the bundled small-plain, or a folder in diffusers' format.",
        "NAME|FOLDER",
    ),
]


def edit_image(
    picture: Annotated[Path, typer.Argument(help="Picture to edit: a PNG, JPEG or TIFF file.")],
    instruction: InstructionOption,
    out: Annotated[Path, option("Write the edited picture to this PNG file.", "FILE")],
    editor: PictureEditorOption = "small-plain",
    seed: Annotated[int, option("Draw the noise by this seed.", "N", min=0)] = 0,
    steps: Annotated[
        int | None,
        option("Denoise in so many steps (default: the editor's own).", "N", min=1, max=1000),
    ] = None,
    size: Annotated[
        int | None,
        option(
            "Edit at this longest side in px; the change is enlarged to the picture's size"
            " (default: the editor's own).",
            "N",
            min=16,
            max=LONGEST_EDIT,
        ),
    ] = None,
    text_guidance: Annotated[
        float | None,
        option("Weigh the words so much; 1 adds no weight (default: the editor's).", "W"),
    ] = None,
    image_guidance: Annotated[
        float | None,
        option("Weigh the picture so much; 1 adds no weight (default: the editor's).", "W"),
    ] = None,
    mask: Annotated[Path | None, option("Edit only what is white in this mask.", "FILE")] = None,
    at: AtOption = None,
    words: WhereOption = None,
    device: DeviceOption = "auto",
    dtype: DtypeOption = "auto",
    low_memory: LowMemoryOption = False,
    threads: ThreadsOption = None,
    anyway: AnywayOption = False,
) -> None:
    """Edit a picture by an instruction."""
    if guide_of(editor) != "picture":
        raise ValueError(f"--editor {editor}: takes depth maps, expected one that takes a picture")
    check_words(editor, instruction, anyway=anyway)
    from attnwarp.io.file import check_other

    if out.suffix.lower() != ".png":
        raise ValueError(f"{out}: expected a name that ends in .png")
    if out.is_dir():
        raise IsADirectoryError(f"{out}: is a folder, expected a PNG file")
    check_other(out, picture, "the picture to edit")
    from attnwarp.command.marks import Marks, bright_of, numbers, say_unmarked, warn_of_much
    from attnwarp.editing.segment import check_marks, cut_out

    marks = Marks(mask=mask, at=numbers(at, "X,Y", "--at"), words=words)
    image = _read(picture)
    check_marks(image.shape[1], image.shape[0], at=marks.at)

    import cv2
    import numpy as np
    import torch

    from attnwarp import check
    from attnwarp.devices import choose
    from attnwarp.drift import drift_or_why
    from attnwarp.editing.editor import edit
    from attnwarp.editing.memory import announced
    from attnwarp.editing.segment import load_segmenter
    from attnwarp.editing.small import dtype_of, load_editor
    from attnwarp.methods.change import mean_change, say_little
    from attnwarp.methods.pictures import edit_size, enlarged_change, resized, to_bytes

    guidance = {"text_guidance": text_guidance, "image_guidance": image_guidance}
    given = {name: value for name, value in guidance.items() if value is not None}
    device = choose(device, splats=False)
    kind = dtype_of(dtype, device, editor)
    if line := announced(editor, kind, device):
        typer.echo(line, err=True)
    model = load_editor(editor, device=device, dtype=kind, low_memory=low_memory, **given)
    model.check_text(instruction)
    torch.set_num_threads(threads or core_count())
    longest = size or model.own_size
    whole = image
    h, w = edit_size(whole.shape[0], whole.shape[1], longest, model.side_multiple)
    image = resized(whole, (h, w))
    share: Any = None
    if mask is not None:
        bright = bright_of(mask, picture, "--mask")
        check.same_aspect(bright.shape, whole.shape[:2], f"--mask: {mask}", "crop or pad it")
        share = cv2.resize(bright.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    elif words is not None:
        share = load_segmenter(SEGMENTER, device=device).segment(image, words)
    elif marks.at is not None:
        warn_of_much(full := cut_out(whole, at=marks.at))
        share = cv2.resize(full.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
    if share is not None:
        share = share[..., None].astype(np.float32)
    with reporter(title=out.name) as report:
        if foreign := say_foreign(editor):
            report.log(foreign)
        if share is None and editor in bundled():
            say_unmarked(editor, report)

        def on_step(step: int, count: int, latents: Any) -> None:
            report.step(step + 1, count, f"{w} x {h} px")

        regions = None if share is None else [share[..., 0]]
        result = edit(
            model, [image], instruction, steps=steps, seed=seed, on_step=on_step, regions=regions
        )
    edited = result.images[0]
    masked = edited if share is None else share * edited + (1 - share) * image
    where = None if share is None else share[..., 0] > 0.5
    change = mean_change([(to_bytes(image), to_bytes(edited), where)])
    if little := say_little({"scene": None, "picture": change}):
        warnings.warn(little, InputWarning, stacklevel=1)
    # The photograph keeps its detail, and the enlarged change is added.
    _write(out, enlarged_change(whole, masked.astype(np.float32)))
    typer.echo(out)
    left = None if share is None else share[..., 0] == 0
    moved = drift_or_why(image, np.clip(edited, 0, 1), left)
    if moved.seen:
        warnings.warn(f"the edit moved the picture, {moved}", InputWarning, stacklevel=1)


def _read(path: Path) -> Image:
    """Read a picture, (H, W, 3) sRGB in [0, 1], in EXIF orientation; transparent pixels are
    composited over black, as in a scene's edit.
    """
    import numpy as np

    from attnwarp.io import read_upright

    stored = read_upright(path)
    values = stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
    return values[..., :3] * values[..., 3:] if stored.shape[2] == 4 else values


def _write(path: Path, image: Image) -> None:
    from attnwarp.cli.files import write_image

    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, image)
