"""Commands about scenes whose truth is exact."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated

import typer

from attnwarp.cli.options import option
from attnwarp.cli.shell import App, fail, log
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import TOO_LITTLE, clear_errors, names, resumable

if TYPE_CHECKING:
    from attnwarp_eval.scene.scene import Scene

app = App(
    help="The scenes whose truth is known: list them, read one, look at one.",
    no_args_is_help=True,
)


@app.command("list")
def list_() -> None:
    """List the scenes that can be named, with their titles."""
    from attnwarp.errors import InputError
    from attnwarp_eval.scene.file import list_scenes, load_scene

    broken = []
    for name in list_scenes():
        try:
            typer.echo(f"{name:12} {load_scene(name).title}")
        except InputError as error:
            broken.append(str(error))
    if broken:
        raise fail("; ".join(broken))


@app.command()
def show(
    scene: Annotated[str, typer.Argument(help="Name of a shipped scene, or the path of its YAML.")],
) -> None:
    """Show what a scene contains, and how its pictures are made."""
    with clear_errors():
        from attnwarp_eval.scene.file import load_scene
        from attnwarp_eval.truth.show import contents, pictures_made

        loaded = load_scene(scene)
        typer.echo(contents(loaded))
        typer.echo(pictures_made(loaded))


@app.command()
def render(
    scene: Annotated[str, typer.Argument(help="Name of a shipped scene, or the path of its YAML.")],
    out: Annotated[
        Path | None,
        option("Write the PNG files to this folder (default runs/scenes/SCENE).", "FOLDER"),
    ] = None,
    views: Annotated[
        str | None,
        option("Render these cameras alone, with commas between names (default all).", "NAMES"),
    ] = None,
    size: Annotated[
        int, option("Render pictures of so many px a side.", "PX", min=16, max=4096)
    ] = 256,
    spp: Annotated[
        int | None,
        option("Take so many samples a pixel (default the scene's own).", "N", min=1),
    ] = None,
) -> None:
    """Render a scene's truth from its cameras: pictures, depth, normals, one sheet of all."""
    with clear_errors():
        from attnwarp_eval.scene.file import load_scene
        from attnwarp_eval.truth.show import render_views

        loaded = load_scene(scene).with_size(size, size)
        _say_open_bounces(loaded)
        folder = out or Path("runs") / "scenes" / loaded.name
        with reporter() as report:
            written = list(render_views(loaded, folder, views=names(views), spp=spp, report=report))
    typer.echo(written[-1])


@app.command()
def export(
    scene: Annotated[str, typer.Argument(help="Name of a shipped scene, or the path of its YAML.")],
    out: Annotated[
        Path, typer.Argument(help="Folder of the export; one that is there is overwritten.")
    ],
    views: Annotated[
        int,
        option("Render so many views around the scene, every 8th of the split 'test'.", "N", min=1),
    ] = 64,
    size: Annotated[
        int, option("Render pictures of so many px a side.", "PX", min=16, max=4096)
    ] = 256,
    spp: Annotated[int, option("Take so many samples a pixel.", "N", min=1)] = 16,
    points: Annotated[
        int, option("Scatter so many points about the surfaces.", "N", min=10)
    ] = 5000,
    noise: Annotated[
        float,
        option(
            "Move points off the surfaces by this standard deviation, in spacings between them.",
            "NUMBER",
            min=0,
            max=1e6,
        ),
    ] = 0.5,
    seed: Annotated[int, option("Draw the points from this seed.", "N", min=0)] = 0,
) -> None:
    """Write a scene as transforms.json, images and points, which `attnwarp fit` reads."""
    with clear_errors():
        import attnwarp_eval.splats.export
        from attnwarp_eval.scene.file import load_scene

        loaded = load_scene(scene)
        _check_no_capture(out)
        _say_open_bounces(loaded)
        with reporter(title=loaded.name) as report:
            attnwarp_eval.splats.export.export(
                loaded, out, views=views, size=size, spp=spp, points=points, noise=noise, seed=seed,
                report=report,
            )  # fmt: skip
    typer.echo(out / "transforms.json")


@app.command()
def draw(
    count: Annotated[int, typer.Argument(min=1, help="Number of scenes to draw.")],
    seed: Annotated[int, option("Draw the population of this seed.", "N", min=0)],
    out: Annotated[Path, option("Write the YAML files to this folder.", "FOLDER")],
    axis: Annotated[
        list[str] | None,
        option(
            "Fix an axis of difficulty from 0 to 1: occlusion, thin, grazing, texture,"
            " highlights; or the number of things, 2 to 6. May be repeated.",
            "NAME=VALUE",
        ),
    ] = None,
    meshes: Annotated[
        Path | None,
        option("Put the meshes (GLB, PLY) of this folder on the ground.", "FOLDER"),
    ] = None,
    shapes: Annotated[
        bool,
        option(
            "Give the scenes edits that add, remove, replace, move and enlarge things.",
            None,
            "--shapes",
        ),
    ] = False,
) -> None:
    """Draw scenes that no one made by hand, with cameras, edits and bounces.

    With --meshes other people's meshes stand on the drawn ground.

    The same seed draws the same files everywhere.
    """
    with clear_errors():
        from attnwarp.errors import InputError
        from attnwarp_eval.drawn.files import write
        from attnwarp_eval.drawn.population import population

        fixed = {}
        for text in axis or ():
            name, _, value = text.partition("=")
            try:
                fixed[name] = float(value)
            except ValueError:
                raise InputError(f"--axis: got {text!r}, expected such as occlusion=0.9") from None
        what: dict[str, object] = {"drawn": count}
        if meshes is not None:
            what = {"meshes": str(meshes), "n": count}
        if shapes:
            what["shapes"] = True
        wanted = population({**what, "seed": seed, "axes": fixed})
        with reporter(title="drawing") as report:
            for k, scene in enumerate(wanted.scenes()):
                write(scene, out)
                report.step(k + 1, count, scene.spec.name)
    typer.echo(f"{wanted.words} -> {out}")


def _say_open_bounces(scene: Scene) -> None:
    """Print one line if the scene's file leaves the number of bounces open."""
    from attnwarp_eval.truth.plan import open_bounces

    for line in open_bounces(scene):
        log(f"{scene.name}: {line}")


def _check_no_capture(folder: Path) -> None:
    """Refuse to overwrite the poses or points of a capture, which could not be recovered.

    Raises:
        InputError: the folder's transforms.json names other views than an export does, or there are
            points without a view of an export.
    """
    import json

    from attnwarp.errors import InputError
    from attnwarp_eval.splats.export import EXPORTED

    path, points = folder / "transforms.json", folder / "points.ply"
    if path.is_file():
        try:
            frames = json.loads(path.read_bytes())["frames"]
            views = [PurePath(frame["file_path"]).name for frame in frames]
        except (ValueError, LookupError, TypeError):
            views = [""]
        exported = all(EXPORTED.fullmatch(view) for view in views)
    else:  # unfinished export
        path, pictures = points, (folder / "images").glob("*")
        exported = not points.exists() or any(EXPORTED.fullmatch(p.name) for p in pictures)
    if not exported:
        raise InputError(
            f"{path}: is of a capture that this command did not write; name another folder"
        )


@app.command()
def edits(
    scene: Annotated[str, typer.Argument(help="Name of a shipped scene, or the path of its YAML.")],
) -> None:
    """List the edits that a scene names, with what each one asks for and does."""
    with clear_errors():
        from attnwarp_eval.scene.file import load_scene
        from attnwarp_eval.truth.edits import describe

        typer.echo(describe(load_scene(scene)))


@app.command()
def calibrate(
    scene: Annotated[str, typer.Argument(help="Name of a shipped scene, or the path of its YAML.")],
) -> None:
    """Measure how many bounces of light a scene and its edits need, and print lines for its file.

    The scene's line belongs under `appearance`, an edit's or answer's under its name. A scene takes
    some ten seconds, minutes where light goes far, as through glass.
    """
    with clear_errors(), reporter() as report:
        from attnwarp_eval.scene.file import load_scene
        from attnwarp_eval.truth.bounces import search, worlds

        for world in worlds(load_scene(scene)):
            report.step(0, 0, f"{world.name}: measuring how often its light bounces")
            found = search(world)
            typer.echo(f"bounces: {found.bounces}  # {world.name}: {found.words}")


@app.command()
def effects(
    scene: Annotated[str, typer.Argument(help="Name of a shipped scene, or the path of its YAML.")],
    as_json: Annotated[
        bool,
        option(
            "Print JSON: effects, plan, geometry, everything_on, cost and proof.", None, "--json"
        ),
    ] = False,
    prove: Annotated[
        bool,
        option("Compare the plan with a rendering with everything on.", None, "--prove"),
    ] = False,
    budget: Annotated[
        float | None,
        option("End a proof's rendering after so many seconds (default 60).", "SECONDS", min=1),
    ] = None,
) -> None:
    """Show which light transport a scene needs, what leaving out the rest saves, and a proof."""
    import json

    if budget is not None and not prove:
        raise fail("--budget: needs --prove, whose seconds it limits")
    seconds = 60.0 if budget is None else budget
    with clear_errors():
        from attnwarp_eval.effects import detect, proof
        from attnwarp_eval.effects.saving import measure
        from attnwarp_eval.scene.file import load_scene

        loaded = load_scene(scene)
        about = detect.report(loaded, cost=measure(loaded))
        result = proof.prove(loaded, seconds=seconds) if prove else None
    if result is not None:
        about["proof"] = result.to_dict()
    lines = [json.dumps(about, indent=2)] if as_json else list(detect.describe(loaded, about))
    if result is not None and not as_json:
        lines += ["", *result.lines()]
    typer.echo("\n".join(lines))
    if result is not None and result.verdict != "certified":
        raise fail(f"{loaded.name}: the plan is not certified: {result.words}", TOO_LITTLE)


@app.command()
def accuracy(
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            help="Scenes' names or paths (default: spheres, bear, glass, fog for pictures; bear,"
            " garden, far for geometry)."
        ),
    ] = None,
    out: Annotated[
        Path,
        option("Write the report, accuracy.json and the figures to this folder.", "FOLDER"),
    ] = Path("runs/accuracy"),
    rounds: Annotated[int, option("Time each setting in so many rounds.", "N", min=3)] = 7,
) -> None:
    """Measure the truth's own error against time, by samples, variant, refinement, visibility."""
    with clear_errors():
        from attnwarp_eval.experiments.accuracy import measure
        from attnwarp_eval.experiments.accuracy.write import write

        with reporter() as report, resumable(lambda: "finished panels are kept"):
            panels = list(measure(scenes or (), out=out, rounds=rounds, report=report))
        for path in write(panels, out):
            typer.echo(path)
