"""Commands that measure a user's pictures, and list the available encoders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from attnwarp.cli.options import option
from attnwarp.cli.shell import fail
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import TOO_LITTLE, clear_errors, resumable


def metrics(
    renders: Annotated[
        Path | None, option("Measure the renders of the edited scene in this folder.", "FOLDER")
    ] = None,
    edited: Annotated[
        Path | None,
        option(
            "Compare the renders with the edited pictures of their names in this folder.",
            "FOLDER",
        ),
    ] = None,
    originals: Annotated[
        Path | None,
        option("Take the views before the edit from this folder, named as the renders.", "FOLDER"),
    ] = None,
    source_edit: Annotated[
        Path | None,
        option("Compare each render with this picture, the edited source view.", "FILE"),
    ] = None,
    prompt: Annotated[
        str | None,
        option("Describe the edited scene, for CLIP to compare with the renders.", "WORDS"),
    ] = None,
    source_prompt: Annotated[
        str | None, option("Describe the scene before, for the CLIP of its change.", "WORDS")
    ] = None,
    clip: Annotated[
        str | None,
        option(
            "Compute the CLIP figures with this encoder: clip-small, clip:FOLDER, or none (default"
            " clip-small).",
            "NAME",
        ),
    ] = None,
    dino: Annotated[
        str | None,
        option(
            "Compute the DINO figures with this encoder: dino-small, dinov2:FOLDER, or none"
            " (default dino-small).",
            "NAME",
        ),
    ] = None,
    perceptual: Annotated[
        str | None,
        option(
            "Compute the perceptual distance with this network: perceptual-small,"
            " lpips:FILE_OR_FOLDER, or none (default perceptual-small).",
            "NAME",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        option(
            "Count the white pixels alone of the masks in this folder, named as the renders, for"
            " Edit PSNR and the perceptual distance; CLIP and DINO see whole pictures.",
            "FOLDER",
        ),
    ] = None,
    consistency: Annotated[
        Path | None,
        option(
            "Measure whether neighbouring views of DATA agree: transforms.json, its folder, or a"
            " COLMAP folder. Its pictures are the edited ones, or with --renders those before the"
            " edit.",
            "DATA",
        ),
    ] = None,
    ply: Annotated[
        Path | None,
        option("Warp for --consistency by the depth of these splats before the edit.", "FILE"),
    ] = None,
    depth: Annotated[
        Path | None,
        option(
            "Warp for --consistency by the depths NAME.npy, (H, W) in the scene's units, in this"
            " folder in place of rendered ones.",
            "FOLDER",
        ),
    ] = None,
    colmap: Annotated[
        bool,
        option(
            "Also reconstruct all views by COLMAP for --consistency; needs the extra colmap.",
            None,
            "--colmap",
        ),
    ] = False,
    background: Annotated[
        str,
        option(
            "Put this colour behind transparent pixels: black, white, or r,g,b in [0, 1].", "COLOR"
        ),
    ] = "black",
    device: Annotated[str, option("Run encoders of yours on this device: cpu or cuda.")] = "cpu",
    out: Annotated[
        Path,
        option("Write metrics.json, metrics.md and metrics.html to this folder.", "FOLDER"),
    ] = Path("runs/metrics"),
    as_json: Annotated[
        bool, option("Print metrics.json in place of a table.", None, "--json")
    ] = False,
) -> None:
    """Edit PSNR, CLIP, DINO and perceptual figures of your own pictures, or their consistency.

    A figure that cannot be computed is named with the reason.
    """
    from rich.console import Console

    with clear_errors():
        from attnwarp.errors import InputError
        from attnwarp_eval.study.store import Store
        from attnwarp_eval.user_images import measure, write
        from attnwarp_eval.user_images.consistency import measure_consistency

        inputs = measure.Inputs(
            renders, edited, originals, source_edit, prompt, source_prompt, mask, consistency, ply,
            _color(background), colmap, depth,
        )  # fmt: skip
        one_view = {
            "--edited": edited, "--source-edit": source_edit, "--prompt": prompt,
            "--source-prompt": source_prompt, "--mask": mask,
        }  # fmt: skip
        unread = [name for name, value in one_view.items() if value is not None]
        if consistency is not None and unread:
            raise InputError(
                f"{unread[0]}: figures of single views do not go with --consistency; leave it out"
                " here, or --consistency"
            )
        posed = {"--ply": ply, "--depth": depth, "--colmap": colmap or None}
        for option, value in posed.items():
            if consistency is None and value is not None:
                raise InputError(f"{option}: needs --consistency DATA, cameras with pictures")
        if (out / "study.json").exists():
            raise InputError(
                f"--out: {out} is the run of a study, to which these figures would be strange;"
                " name another folder"
            )
        kinds: dict[Any, str | None] = {"clip": clip, "dino": dino, "perceptual": perceptual}
        work = measure.measure if consistency is None else measure_consistency
        with reporter() as report, resumable(lambda: "finished batches of views are kept"):
            measured = work(inputs, kinds, Store(out), device=device, report=report)
        paths = write.write(measured, out)
    if as_json:
        typer.echo(write.to_json(measured), nl=False)
    else:
        Console().print(write.table(measured))
        for kind, about in measured.encoders.items():
            typer.echo(f"{kind}: {about.name}, weights {about.weights_sha256[:12]}")
    for what, why in measured.missing.items():
        typer.echo(f"not computed: {what}: {why}", err=True)
    for line in (*measured.unpaired, *measured.notes):
        typer.echo(line, err=True)
    for path in paths:
        typer.echo(path, err=as_json)
    if not measured.any_value:
        raise fail("every figure is undefined on these pictures; see the notes above", TOO_LITTLE)


def _color(text: str) -> tuple[float, float, float]:
    from attnwarp.errors import InputError

    named = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    if text in named:
        return named[text]
    try:
        r, g, b = (float(part) for part in text.split(","))
    except ValueError:
        r = g = b = -1.0
    if not all(0 <= value <= 1 for value in (r, g, b)):
        raise InputError(
            f"--background: got {text!r}, expected black, white or r,g,b in [0, 1] such as"
            " 0.2,0.5,1"
        )
    return r, g, b


def encoders(
    name: Annotated[
        str | None,
        typer.Argument(help="Load this encoder and show what it is; without it, list them."),
    ] = None,
) -> None:
    """List the encoders that metrics can use.

    Some ship with the package, others are read from a folder of yours.
    """
    with clear_errors():
        from attnwarp_eval.encoders import BUNDLED, REAL, load_encoder

        if name is not None:
            about = load_encoder(name).about.to_dict()
            lines = [f"{key:15} {value}" for key, value in about.items()]
        else:
            lines = ["ships with the package:"]
            lines += [f"  {n:22} {kind:11} {line}" for n, (kind, line) in BUNDLED.items()]
            lines += [
                "read from a place of yours (docs/measuring/your-images.md says which files):"
            ]
            lines += [f"  {n:22} {kind:11} {line}" for n, (kind, line) in REAL.items()]
    typer.echo("\n".join(lines))
