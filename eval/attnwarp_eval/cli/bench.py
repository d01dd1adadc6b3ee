"""Commands of the bench: scenes for methods that live elsewhere, and scores of their pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from attnwarp.cli.shell import App
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import clear_errors, resumable

app = App(
    help="A bench for methods that live elsewhere: scenes as files, and scores.",
    no_args_is_help=True,
)

SMALL = 3


@app.command()
def export(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the bench; one begun earlier is continued.")
    ],
    scenes: Annotated[int, typer.Option(min=1, help="Draw so many scenes.")] = 12,
    small: Annotated[
        bool, typer.Option("--small", help=f"Draw {SMALL} scenes, for a trial.")
    ] = False,
    size: Annotated[
        int, typer.Option(min=16, max=1024, help="Render pictures of so many px a side.")
    ] = 256,
    spp: Annotated[int, typer.Option(min=1, help="Render with so many samples a pixel.")] = 16,
    targets: Annotated[
        int, typer.Option(min=1, max=15, help="Write so many views beside the source.")
    ] = 15,
    seed: Annotated[int, typer.Option(min=0, help="Draw the scenes by this seed.")] = 0,
) -> None:
    """Write scenes with pictures, cameras, depth, masks, splats, instructions, and their truth."""
    with clear_errors(), reporter(title=folder.name) as report:
        from attnwarp_eval.bench.suite import export as write

        with resumable(lambda: "finished scenes are kept"):
            write(
                folder, count=SMALL if small else scenes, seed=seed, size=size, spp=spp,
                targets=targets, report=report,
            )  # fmt: skip
    typer.echo(folder / "README.md")


@app.command()
def run(
    folder: Annotated[Path, typer.Argument(help="The exported bench.")],
    out: Annotated[Path, typer.Argument(help="Folder to hand in; one begun earlier is continued.")],
    method: Annotated[
        str,
        typer.Option(help="Edit by this method, of the package or a plugin; warp needs no editor."),
    ] = "attention_warping",
    editor: Annotated[
        str,
        typer.Option(
            help="Edit with this bundled editor, a folder in diffusers' format, or ideal."
        ),
    ] = "small-plain",
    seed: Annotated[
        int,
        typer.Option(
            min=0, help="Draw the first scene's noise by this seed, the others' by later ones."
        ),
    ] = 0,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="Change a setting of the method; may be repeated."
        ),
    ] = None,
) -> None:
    """Edit the scenes by a method of ours, or of a plugin, with an editor of ours, or warp them."""
    # As in "attnwarp edit", a method's ValueError is about the input.
    with clear_errors(strict=False), reporter(title=out.name) as report:
        from attnwarp.cli.shell import assignments
        from attnwarp.io.lock import alone_in
        from attnwarp_eval.bench.run import run as edit

        options = assignments(changes or [], {"seed": "--seed"})
        with resumable(lambda: "finished edits are kept"), alone_in(out):
            edit(folder, out, method, editor, options=options, seed=seed, report=report)
    typer.echo(out / "method.json")


@app.command()
def score(
    folder: Annotated[Path, typer.Argument(help="The exported bench.")],
    edited: Annotated[
        Path, typer.Argument(help="Folder with SCENE/EDIT/VIEW.png, or warps as SCENE/VIEW.npz.")
    ],
    out: Annotated[
        Path, typer.Option(help="Write bench-score.json and its page to this folder.")
    ] = Path("runs/bench"),
) -> None:
    """Score edited pictures of a bench, or warps, against its truth, which is made again."""
    from rich.console import Console

    with clear_errors(), reporter(title=edited.name) as report:
        from attnwarp_eval.bench.result import table as of_scores
        from attnwarp_eval.bench.score import score as measure
        from attnwarp_eval.document.write import terminal

        with resumable(lambda: "finished edits are kept"):
            result = measure(folder, edited, out, report)
    Console().print(terminal(of_scores(result.scores)))
    for remark in result.remarks:
        typer.echo(remark, err=True)
    typer.echo(out / "bench-score.html")


@app.command()
def table(
    results: Annotated[
        list[Path], typer.Argument(help="bench-score.json of each method; the first is paired.")
    ],
    out: Annotated[Path, typer.Option(help="Write bench.md and its page to this folder.")] = Path(
        "runs/bench"
    ),
) -> None:
    """Compare the scores of methods on one bench, paired by scene."""
    with clear_errors():
        from attnwarp_eval.bench.result import Result, compare
        from attnwarp_eval.document.write import write_files

        report = compare([Result.read(path) for path in results])
    typer.echo(write_files(report, out, "bench")[-1])
