"""Command attnwarp, and its handling of errors at the end."""

from __future__ import annotations

from attnwarp.cli import shell
from attnwarp.cli.convert import convert, undistort
from attnwarp.cli.edit import edit
from attnwarp.cli.edit_image import edit_image
from attnwarp.cli.fit import fit
from attnwarp.cli.inspect import inspect
from attnwarp.cli.options import program_options
from attnwarp.cli.poses import poses
from attnwarp.cli.render import render

app = shell.App(
    name="attnwarp",
    help=(
        "Gaussian splats for consistent 3D scene editing: fit them to pictures, edit, render and"
        " convert them."
    ),
    epilog=(
        "Exit codes: 0 done, 2 wrong usage or input, 130 stopped by Ctrl-C or kill with everything"
        " so far written, 141 output pipe closed."
    ),
    no_args_is_help=True,
    add_completion=False,
)

app.callback()(program_options)
app.command()(poses)
app.command()(fit)
app.command()(edit)
app.command()(render)
app.command()(convert)
app.command()(undistort)
app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})(inspect)
app.command("edit-image")(shell.clear_errors()(edit_image))


def main(name: str = "attnwarp") -> None:
    """Run the console script."""
    shell.run(app, name)


if __name__ == "__main__":
    main()
