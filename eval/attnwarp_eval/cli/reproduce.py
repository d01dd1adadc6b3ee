"""The command that repeats the paper's tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from attnwarp.cli.shell import fail
from attnwarp.reporting import reporter
from attnwarp_eval.cli.shell import TOO_LITTLE, clear_errors, resumable, scheduler_lost

if TYPE_CHECKING:
    from attnwarp_eval.reproduce.manifest import Loaded


def reproduce(
    manifest: Annotated[
        str, typer.Argument(help="A manifest's YAML, or `paper`, which ships with the package.")
    ],
    out: Annotated[Path, typer.Option(help="The run's folder.")] = Path("runs/reproduction"),
    device: Annotated[
        str,
        typer.Option(
            metavar="DEVICE[,DEVICE...]",
            help="cpu, cuda, or several such as cuda:0,cuda:1: one process each.",
        ),
    ] = "cpu",
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", min=1, help="Processes; one a device if left out.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS|FILE",
            help="A dask scheduler, whose workers see this folder and the manifest's.",
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="One scene, one edit, one seed, two methods.")
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Check everything, tell hours, disk and memory, and run nothing."
        ),
    ] = False,
    write_probes: Annotated[
        bool,
        typer.Option(
            "--write-probes",
            help="Write the probe values that MANIFEST lacks into it, from your weights; run"
            " nothing.",
        ),
    ] = False,
) -> None:
    """Run the paper's tables on captures and weights of one's own, beside its numbers.

    Everything is checked before anything runs. Killed and started again, it goes on.
    """
    from attnwarp.devices import device_of
    from attnwarp_eval.reproduce import cells, check
    from attnwarp_eval.reproduce.manifest import lacking, load_manifest, shipped
    from attnwarp_eval.reproduce.seal import open_seal, write_seal
    from attnwarp_eval.study.store import Store

    if scheduler is not None and jobs is not None:
        raise fail("--jobs starts workers here, --scheduler uses others; give one of the two")
    with clear_errors(), reporter(every=True) as report:
        loaded = load_manifest(manifest)
        loaded = loaded.quick() if quick else loaded
        devices = [part.strip() for part in device.split(",")]
        for name in devices if scheduler is None else ():
            device_of(name)
        unknown = lacking(loaded.manifest)
        if write_probes:
            if manifest in shipped():
                raise fail(f"--write-probes: {manifest} ships with the package; copy it first")
            _write_probes(Path(manifest), loaded, unknown, devices[0])
            return
        store = Store(out)
        report.log("checking captures and weights")
        checked = check.check(loaded, out, devices[0] if scheduler is None else "cpu")
        checked.refuse()
        planned = cells.plan(loaded, checked, out, devices)
        left = cells.todo(planned.cells, store)
        for name, (sha256, probe) in checked.weights.items():
            report.log(f"{name}: probe {probe:.6g}, sha256 {sha256}")
        if unknown:
            report.log(
                f"{', '.join(unknown)}: the manifest has no probe value, so another checkpoint of"
                " the same shapes would pass too; whoever has the published weights fills it in"
                " with --write-probes"
            )
        report.log(f"{len(planned.cells)} cells, {len(planned.cells) - len(left)} done in {out}")
        if dry_run:
            from attnwarp_eval.reproduce.estimate import estimate

            for line in estimate(planned, left, devices, report):
                typer.echo(line)
            return
        store.refuse_strangers()
        with store.lock(), resumable(lambda: f"{len(store.done())} cells are kept"):
            if broken := open_seal(store, planned.cells):
                report.log(
                    f"{len(broken)} sealed files are missing or changed and are made anew:"
                    f" {', '.join(broken[:8])}{' ...' * (len(broken) > 8)}"
                )
            store.write_study(cells.expected(planned))
            with scheduler_lost(scheduler, lambda: len(store.done())):
                failures = cells.execute(
                    planned, store, jobs=jobs or len(devices), scheduler=scheduler, report=report
                )
            from attnwarp_eval.reproduce.report import write_report

            paths = [*write_report(planned, store), write_seal(store)]
        for path in paths:
            typer.echo(path)
    if failures:
        listed = "; ".join(f"{f.title}: {f.error}" for f in failures)
        raise fail(
            f"{len(failures)} cells failed; the same command tries them again: {listed}", TOO_LITTLE
        )


def _write_probes(path: Path, loaded: Loaded, unknown: list[str], device: str) -> None:
    """Write the probe values of weights that the manifest can't tell from others."""
    from attnwarp_eval.reproduce import check, manifest

    checked = check.Checked()
    check.check_weights(loaded, device, checked)
    checked.refuse()
    found = {key: checked.weights[key][1] for key in unknown}
    manifest.write_probes(path, found)
    for key, value in found.items():
        typer.echo(f"{path}: {key}.probe: {value:.6g}")
    if not found:
        typer.echo(f"{path}: has a probe value or a hash of all weights")
