"""The command line: attnwarp-eval. Nothing heavy is imported until a command needs it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from attnwarp_eval.study.run import Plan, Summary
    from attnwarp_eval.study.store import Store

PASS, REGRESSION, USAGE, TOO_LITTLE, CRASH = 0, 1, 2, 3, 70
"""Exit codes. 1 is kept for a regression; an unusable input is 2; a run that measured too little,
or with an instrument that is not calibrated, is 3; a fault of this program is 70, as in
sysexits."""

app = typer.Typer(
    name="attnwarp-eval",
    help=(
        "Check warps, masks and depth of Gaussian scenes against exact truth, and report what"
        " accuracy costs in time."
    ),
    epilog=(
        "Exit codes: 0 pass, 1 regression, 2 wrong usage or input, 3 nothing or too little was"
        " measured; 130 interrupted."
    ),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
scenes_app = typer.Typer(
    help="The scenes whose truth is known: list them, read one, look at one.", no_args_is_help=True
)
app.add_typer(scenes_app, name="scenes")
cache_app = typer.Typer(
    help="Derived files (meshes, true pictures, splats), kept to save time.", no_args_is_help=True
)
app.add_typer(cache_app, name="cache")


def fail(message: str, code: int = USAGE) -> typer.Exit:
    """Say what went wrong on stderr; raise what this returns."""
    typer.echo(f"attnwarp-eval: {message}", err=True)
    return typer.Exit(code)


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn errors about a person's input into one clear line and exit code 2."""
    from attnwarp.errors import InputError

    try:
        yield
    except InputError as error:
        raise fail(str(error)) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise fail(
            f"{where}{error.strerror or error}; check the path, the space on its disk and its"
            " permissions"
        ) from None


def _split(text: str | None) -> list[str] | None:
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]


@app.command()
def run(
    study: Annotated[
        str, typer.Argument(help="A study that ships (quick) or the path of a study's YAML.")
    ] = "quick",
    out: Annotated[
        Path | None, typer.Option(help="The run's folder; runs/<study> if left out.")
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", min=1, help="Worker processes; 1 stays in this one.")
    ] = 1,
    scenes: Annotated[
        str | None, typer.Option(help="Only these scenes (comma-separated names or paths).")
    ] = None,
    size: Annotated[
        int | None, typer.Option(min=16, max=4096, help="Image size in px, not the study's.")
    ] = None,
    keep_going: Annotated[
        bool, typer.Option("--keep-going/--fail-fast", help="After a failed cell.")
    ] = True,
) -> None:
    """Run a study and write its report. Killed half-way and started again, it goes on where it
    was."""
    from attnwarp_eval.study import run as runner
    from attnwarp_eval.study.store import Store
    from attnwarp_eval.study.study import load_study

    with clear_errors():
        loaded = load_study(study, scenes=_split(scenes), size=size)
        store = Store(out or Path("runs") / loaded.name)
        planned = runner.plan(loaded, store)
        with store.lock():
            if planned.other_code:
                typer.echo(
                    f"attnwarp-eval: {planned.other_code} of the cells in {store.root} were"
                    " computed by other code than this; they are kept, and the report says so."
                    " Name another folder with --out to start afresh.",
                    err=True,
                )
            try:
                summary = _watch(planned, store, jobs, keep_going)
            except KeyboardInterrupt:
                kept = len(store.done())
                raise fail(
                    f"interrupted; {kept} cells are kept, the same command goes on from here", 130
                ) from None
            _write_report(store)
            uncalibrated = _calibration_problems(store)
    _print_failures(summary)
    if not summary.complete:
        missing = summary.expected - summary.reused - summary.computed
        raise fail(
            f"{missing} of {summary.expected} cells were not measured; run again to retry them",
            TOO_LITTLE,
        )
    if uncalibrated:
        raise fail("the instrument is not calibrated: " + "; ".join(uncalibrated), TOO_LITTLE)


def _calibration_problems(store: Store) -> list[str]:
    from attnwarp_eval.report.calibration import problems
    from attnwarp_eval.report.results import Results

    return problems(Results.of(store))


def _watch(planned: Plan, store: Store, jobs: int, keep_going: bool) -> Summary:
    """Run with a progress bar on a terminal, or a line a cell where there is none."""
    from rich.console import Console

    from attnwarp_eval.study import run as runner

    console = Console(stderr=True)
    reused = f", {planned.reused} already done" if planned.reused else ""
    console.print(
        f"study [bold]{planned.study.name}[/bold]: {len(planned.cells)} cells{reused} ->"
        f" {store.root}",
        highlight=False,
    )
    with _bar(console) as bar:
        task = bar.add_task("starting", total=len(planned.cells), completed=planned.reused)
        finished = planned.reused

        def listen(event: str, info: dict[str, Any]) -> None:
            nonlocal finished
            if event == "start":
                bar.update(task, description=info["title"])
                return
            finished += 1
            bar.advance(task)
            if event == "failed" or not console.is_terminal:
                word = "" if event == "done" else f" FAILED: {info['error']}"
                console.print(
                    f"[{finished}/{len(planned.cells)}] {info['title']}{word}",
                    markup=False,
                    highlight=False,
                )

        return runner.execute(planned, store, jobs=jobs, keep_going=keep_going, listen=listen)


def _bar(console: Console) -> Progress:
    """A progress bar; nothing where there is no terminal."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal)


def _print_failures(summary: Summary) -> None:
    if not summary.failures:
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("scene", "variant", "probe", "error", title="failed cells")
    for failure in summary.failures:
        table.add_row(failure["scene"], failure["variant"], failure["probe"], failure["error"])
    Console(stderr=True).print(table)


def _write_report(store: Store, *, timings: bool = True, pictures: bool = True) -> None:
    from attnwarp_eval.report import write_report

    for path in write_report(store, timings=timings, pictures=pictures):
        typer.echo(path)


@app.command()
def report(
    run: Annotated[Path, typer.Argument(help="The run's folder.")],
    timings: Annotated[bool, typer.Option(help="Without: no seconds, to compare runs.")] = True,
    pictures: Annotated[bool, typer.Option(help="Without: tables and figures alone.")] = True,
) -> None:
    """Make report.md, report.html and results.jsonl again from the cells of a run."""
    from attnwarp_eval.study.store import Store

    with clear_errors():
        _write_report(Store(run), timings=timings, pictures=pictures)


@app.command()
def verify(run: Annotated[Path, typer.Argument(help="The run's folder.")]) -> None:
    """Recompute the hashes of a run's cells and pictures and compare with the list of expected
    cells.
    """
    from attnwarp_eval.study import run as runner
    from attnwarp_eval.study.store import Store

    with clear_errors():
        problems = runner.verify(Store(run))
    for what, items in (
        ("damaged", problems.damaged),
        ("failed", problems.failed),
        ("missing", problems.missing),
        ("not of this study (kept)", problems.unexpected),
    ):
        for item in items:
            typer.echo(f"{what}: {item}")
    if not problems.ok:
        bad = len(problems.damaged) + len(problems.failed) + len(problems.missing)
        raise fail(
            f"{run}: {bad} problems in {problems.checked} cells; run the study again to mend them",
            TOO_LITTLE,
        )
    typer.echo(f"{run}: {problems.checked} cells, every hash fits, none is missing")


@scenes_app.command("list")
def list_() -> None:
    """The scenes that can be named."""
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


@scenes_app.command()
def show(
    scene: Annotated[str, typer.Argument(help="A scene's name, or the path of its YAML.")],
) -> None:
    """What a scene contains, and how its pictures are made."""
    with clear_errors():
        from attnwarp_eval.scene.file import load_scene
        from attnwarp_eval.truth.show import describe

        typer.echo(describe(load_scene(scene)))


@scenes_app.command()
def render(
    scene: Annotated[str, typer.Argument(help="A scene's name, or the path of its YAML.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the PNG files; runs/scenes/<scene> if left out.")
    ] = None,
    views: Annotated[
        str | None, typer.Option(help="Only these cameras (comma-separated names).")
    ] = None,
    size: Annotated[int, typer.Option(min=16, max=4096, help="Image size in px.")] = 256,
    spp: Annotated[
        int | None, typer.Option(min=1, help="Samples a pixel, not the scene's.")
    ] = None,
) -> None:
    """Render a scene's truth from its cameras: pictures, depth, normals, and one sheet of them
    all."""
    from rich.console import Console

    with clear_errors():
        from attnwarp_eval.scene.file import load_scene
        from attnwarp_eval.truth.show import render_views

        loaded = load_scene(scene).with_size(size, size)
        folder = out or Path("runs") / "scenes" / loaded.name
        with Console(stderr=True).status("starting") as status:
            written = list(
                render_views(loaded, folder, views=_split(views), spp=spp, progress=status.update)
            )
    typer.echo(written[-1])


@scenes_app.command()
def export(
    scene: Annotated[str, typer.Argument(help="A scene's name, or the path of its YAML.")],
    out: Annotated[Path, typer.Argument(help="Folder; what is in it already is overwritten.")],
    views: Annotated[
        int, typer.Option(min=1, help="Views around the scene; every 8th is of the split 'test'.")
    ] = 64,
    size: Annotated[int, typer.Option(min=16, max=4096, help="Image size in px.")] = 256,
    spp: Annotated[int, typer.Option(min=1, help="Samples a pixel.")] = 16,
    points: Annotated[
        int, typer.Option(min=10, help="Points scattered about the surfaces.")
    ] = 5000,
    noise: Annotated[
        float, typer.Option(min=0, help="How far, in spacings between the points.")
    ] = 0.5,
    seed: Annotated[int, typer.Option(min=0, help="Of the points.")] = 0,
) -> None:
    """Write a scene as transforms.json, images and points: what `attnwarp fit` and other programs
    read.
    """
    from rich.console import Console

    with clear_errors():
        from attnwarp_eval.scene.file import load_scene
        from attnwarp_eval.splats import fitted

        loaded = load_scene(scene)
        with Console(stderr=True).status("points") as status:
            fitted.export(
                loaded, out, views=views, size=size, spp=spp, points=points, noise=noise, seed=seed,
                progress=lambda text: status.update(f"{loaded.name}: {text}"),
            )  # fmt: skip
    typer.echo(out / "transforms.json")


@scenes_app.command()
def edits(
    scene: Annotated[str, typer.Argument(help="A scene's name, or the path of its YAML.")],
    as_json: Annotated[
        bool, typer.Option("--json", help="JSON, with the content hash of each result.")
    ] = False,
) -> None:
    """The edits that a scene names, with what each one asks for and does."""
    import json

    with clear_errors():
        from attnwarp_eval.scene.file import load_scene
        from attnwarp_eval.truth import edits as known

        loaded = load_scene(scene)
        typer.echo(
            json.dumps(known.to_dict(loaded), indent=2) if as_json else known.describe(loaded)
        )


@scenes_app.command()
def effects(
    scene: Annotated[
        str | None, typer.Argument(help="A scene's name, or the path of its YAML.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="JSON with the keys effects and plan.")
    ] = False,
    prove: Annotated[
        bool, typer.Option("--prove", help="Hold the plan against a rendering with everything on.")
    ] = False,
    budget: Annotated[float, typer.Option(min=1, help="Seconds that a proof may render.")] = 60.0,
    every: Annotated[
        bool,
        typer.Option(
            "--all", help="A table and pictures of every scene; goes on where it was left."
        ),
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder of --all.")] = Path("runs/effects"),
) -> None:
    """Which light transport a scene needs, how it is rendered, what that saves, and a proof that
    nothing is lost.
    """
    import json

    if every == (scene is not None):
        raise fail("name one scene, or say --all for a table of all of them")
    if every:
        if as_json:
            raise fail("--json is of one scene; --all writes effects.json into --out")
        _effects_of_all(out, prove, budget)
        return
    with clear_errors():
        from attnwarp_eval.effects import detect as light
        from attnwarp_eval.effects.proof import prove as hold
        from attnwarp_eval.scene.file import load_scene

        loaded = load_scene(str(scene))
        about = light.report(loaded, cost=light.measure(loaded))
        proof = hold(loaded, seconds=budget) if prove else None
    if proof is not None:
        about["proof"] = proof.to_dict()
    lines = [json.dumps(about, indent=2)] if as_json else list(light.describe(loaded, about))
    if proof is not None and not as_json:
        lines += ["", *proof.lines()]
    typer.echo("\n".join(lines))
    if proof is not None and proof.verdict != "certified":
        raise fail(f"{loaded.name}: the plan is not certified: {proof.words}", TOO_LITTLE)


def _effects_of_all(out: Path, prove: bool, budget: float) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    with clear_errors():
        from attnwarp_eval.effects.table import Settings, collect, proof_words
        from attnwarp_eval.scene.file import list_scenes

        names = list_scenes()
        console = Console(stderr=True)
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
            task = bar.add_task("starting", total=len(names))

            def watch(text: str, done: int) -> None:
                bar.update(task, description=text, completed=done)
                if not console.is_terminal:
                    console.print(
                        f"[{done + 1}/{len(names)}] {text}", markup=False, highlight=False
                    )

            try:
                entries = collect(names, out, Settings(prove=prove, budget=budget), watch)
            except KeyboardInterrupt:
                raise fail(
                    "interrupted; finished scenes are kept, the same command goes on from here", 130
                ) from None
            bar.update(task, description="done", completed=len(names))
    typer.echo(out / "effects.md")
    doubtful = [f"{e['scene']}: {proof_words(e['proof'])}" for e in entries if "proof" in e
                and e["proof"]["verdict"] != "certified"]  # fmt: skip
    if doubtful:
        raise fail(f"not every plan is certified: {'; '.join(doubtful)}", TOO_LITTLE)


@scenes_app.command()
def accuracy(
    scenes: Annotated[
        list[str] | None,
        typer.Argument(help="Scenes' names or paths; a few telling ones if left out."),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder for accuracy.md, accuracy.json and the figures.")
    ] = Path("runs/accuracy"),
    rounds: Annotated[int, typer.Option(min=3, help="Of every timing.")] = 7,
) -> None:
    """Error of the truth itself against time: samples a pixel, Mitsuba's variant, float64
    refinement, visibility.
    """
    from rich.console import Console

    with clear_errors():
        from attnwarp_eval.experiments import accuracy as truth

        with Console(stderr=True).status("starting") as status:
            panels = truth.measure(scenes or (), rounds=rounds, progress=status.update)
        for path in truth.write(panels, out):
            typer.echo(path)


@scenes_app.command("time")
def time_(
    scenes: Annotated[
        list[str] | None, typer.Argument(help="Scenes' names or paths; all if left out.")
    ] = None,
    views: Annotated[int, typer.Option(min=1, help="Views of each scene, the source first.")] = 8,
    size: Annotated[int, typer.Option(min=16, max=4096, help="Of the pictures, px.")] = 256,
    spp: Annotated[int, typer.Option(min=1, help="Samples a pixel.")] = 64,
    geometry_size: Annotated[
        int, typer.Option(min=16, max=4096, help="Of depth and ids, px.")
    ] = 512,
    as_json: Annotated[
        bool, typer.Option("--json", help="JSON, with every scene's stages.")
    ] = False,
) -> None:
    """How long the truth takes from nothing (an empty cache of its own): meshes, geometry,
    pictures.
    """
    import json

    from rich.console import Console
    from rich.table import Table

    with clear_errors():
        from attnwarp_eval.experiments import suite
        from attnwarp_eval.scene.file import list_scenes

        console, times = Console(stderr=True), []
        with console.status("starting") as status:
            for taken in suite.measure(
                scenes or list_scenes(),
                views=views,
                size=size,
                spp=spp,
                geometry_size=geometry_size,
                progress=status.update,
            ):
                times.append(taken)
                # All of them take minutes: what is known is told at once.
                console.print(f"{taken.scene}: {sum(taken.wall.values()):.1f} s", highlight=False)
    if as_json:
        typer.echo(json.dumps(suite.to_dict(times), indent=1))
        return
    columns, rows = suite.columns_and_rows(times)
    table = Table(*columns, caption="wall, with CPU in brackets")
    for row in rows:
        table.add_row(*row)
    Console(width=160).print(table)


@cache_app.command()
def info() -> None:
    """Where the derived files lie, how many, how large."""
    from attnwarp_eval import cache

    with clear_errors():
        typer.echo(
            f"{cache.cache_dir()} (limit {cache.limit_bytes() / 1e9:g} GB, ATTNWARP_CACHE_GB"
            " changes it)"
        )
        table = cache.usage()
    for kind, (count, size) in table.items():
        typer.echo(f"{kind:12} {count:6} files {size / 1e6:10.1f} MB")
    typer.echo(
        f"{'all':12} {sum(c for c, _ in table.values()):6} files"
        f" {sum(s for _, s in table.values()) / 1e6:10.1f} MB"
    )


@cache_app.command()
def clear() -> None:
    """Remove them all; everything is computed again when it is needed."""
    from attnwarp_eval import cache

    with clear_errors():
        typer.echo(f"{cache.cache_dir()}: {cache.trim(0) / 1e6:.1f} MB removed")


@app.command()
def studies() -> None:
    """List the studies that ship with the package."""
    from attnwarp_eval.study.study import load_study, shipped_studies

    for name in shipped_studies():
        loaded = load_study(name)
        typer.echo(f"{name:12} {loaded.title}")


@app.command()
def metrics(
    renders: Annotated[
        Path | None, typer.Option(help="Folder: renders of the edited scene.")
    ] = None,
    edited: Annotated[
        Path | None, typer.Option(help="Folder: the edited pictures, named as the renders.")
    ] = None,
    originals: Annotated[
        Path | None, typer.Option(help="Folder: the views before the edit, named alike.")
    ] = None,
    source_edit: Annotated[
        Path | None, typer.Option(help="Picture: the edited source view.")
    ] = None,
    prompt: Annotated[str | None, typer.Option(help="What the edited scene should show.")] = None,
    source_prompt: Annotated[str | None, typer.Option(help="What the scene showed before.")] = None,
    clip: Annotated[
        str | None,
        typer.Option(
            help="clip-small, clip:FOLDER or none; clip-small if left out.", metavar="NAME"
        ),
    ] = None,
    dino: Annotated[
        str | None,
        typer.Option(
            help="dino-small, dinov2:FOLDER or none; dino-small if left out.", metavar="NAME"
        ),
    ] = None,
    perceptual: Annotated[
        str | None,
        typer.Option(
            help="perceptual-small, lpips:FILE_OR_FOLDER or none; perceptual-small if left out.",
            metavar="NAME",
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(
            help=(
                "Folder: masks named as the renders; white counts for Edit PSNR and the perceptual"
                " distance. The others "
                "see whole pictures."
            )
        ),
    ] = None,
    background: Annotated[
        str, typer.Option(help="Behind transparent pixels: black, white, or r,g,b in [0, 1].")
    ] = "black",
    device: Annotated[str, typer.Option(help="cpu or cuda, for real encoders.")] = "cpu",
    out: Annotated[Path, typer.Option(help="Folder for metrics.json and metrics.md.")] = Path(
        "runs/metrics"
    ),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print metrics.json instead of a table.")
    ] = False,
) -> None:
    """Edit PSNR, CLIP, DINO and perceptual figures of your own pictures. What is left out is said,
    with the reason.
    """
    from rich.console import Console

    with clear_errors():
        from attnwarp_eval.user_images import measure, write

        inputs = measure.Inputs(
            renders, edited, originals, source_edit, prompt, source_prompt, mask, _color(background)
        )
        names: dict[Any, str | None] = {"clip": clip, "dino": dino, "perceptual": perceptual}
        console = Console(stderr=True)
        with _bar(console) as bar:
            task = bar.add_task("starting", total=None)
            measured = measure.measure(
                inputs,
                names,
                device=device,
                progress=lambda done, total, view: bar.update(
                    task, completed=done, total=total, description=view
                ),
            )
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


@app.command()
def encoders(
    name: Annotated[str | None, typer.Argument(help="Load this one and say what it is.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON.")] = False,
) -> None:
    """The encoders that metrics can use: what ships with the package, and what is read from a
    folder of yours.
    """
    import json

    with clear_errors():
        from attnwarp import encoders as known

        if name is not None:
            about = known.load_encoder(name).about.to_dict()
            lines = (
                [json.dumps(about, indent=2)]
                if as_json
                else [f"{key:15} {value}" for key, value in about.items()]
            )
        elif as_json:
            rows = [
                {"name": n, "kind": kind, "about": line, "bundled": n in known.BUNDLED}
                for n, (kind, line) in (known.BUNDLED | known.REAL).items()
            ]
            lines = [json.dumps(rows, indent=2)]
        else:
            lines = ["ships with the package:"]
            lines += [f"  {n:22} {kind:11} {line}" for n, (kind, line) in known.BUNDLED.items()]
            lines += ["read from a place of yours (docs/encoders.md says which files go there):"]
            lines += [f"  {n:22} {kind:11} {line}" for n, (kind, line) in known.REAL.items()]
    typer.echo("\n".join(lines))


def main() -> None:
    """Entry point of the console script."""
    import traceback

    from attnwarp.errors import missing_extra

    try:
        app()
    except Exception as error:
        explained = missing_extra(error) if isinstance(error, ImportError) else None
        if explained is not None:
            typer.echo(f"attnwarp-eval: {explained}", err=True)
            raise SystemExit(USAGE) from None
        # Python's own exit code for a crash is 1, which here means a regression.
        traceback.print_exc()
        raise SystemExit(CRASH) from None


if __name__ == "__main__":
    main()
