"""Commands about derived files: their size, and their removal."""

from __future__ import annotations

import typer

from attnwarp.cli.shell import App
from attnwarp_eval.cli.shell import clear_errors

app = App(
    help="Derived files (meshes, true pictures, splats), kept to save time.",
    no_args_is_help=True,
)


@app.command()
def info() -> None:
    """Show the folder of the derived files, their number and their size."""
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


@app.command()
def clear() -> None:
    """Remove them all; everything is computed again when it is needed."""
    from attnwarp_eval import cache

    with clear_errors():
        typer.echo(f"{cache.cache_dir()}: {cache.trim(0) / 1e6:.1f} MB removed")
