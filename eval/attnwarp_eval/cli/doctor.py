"""The command that lists this machine's abilities, and the cost of each lack."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Annotated

import typer

from attnwarp.cli.options import option
from attnwarp.cli.shell import USAGE, fail
from attnwarp_eval.cli.shell import clear_errors

if TYPE_CHECKING:
    from attnwarp_eval.cli.machine import Check

WIDTH = 79
"""Width of a line, for a terminal of 80 columns."""


def doctor(
    json: Annotated[bool, option("Every check as JSON.", None, "--json")] = False,
) -> None:
    """Check what this machine has, and tell what each lack costs.

    Exit code 2 if something needed is broken.
    """
    from dataclasses import asdict

    from attnwarp_eval.canonical_json import canonical_json
    from attnwarp_eval.cli.machine import checks

    results: list[Check] = []
    with clear_errors():
        for check in checks():
            results.append(check)
            if not json:
                typer.echo(lines(check))
        if json:
            typer.echo(canonical_json([asdict(check) for check in results]))
    broken = [check.name for check in results if check.state == "broken"]
    if broken:
        raise fail(f"broken: {', '.join(broken)}", USAGE)
    if not json:
        lacking = sum(check.state == "lack" for check in results)
        costs = f"; {lacking} lack{'s' if lacking > 1 else ''}, each at the cost that it names"
        typer.echo(f"\nEverything needed works{costs if lacking else ''}.")


def lines(check: Check) -> str:
    """Text lines of a check: its state and name, then the finding, the cost, and the remedy."""
    paragraphs = [(f"{check.state:7}", " " * 7, f"{check.name}: {check.text}")]
    for title, text in (("cost", check.cost), ("remedy", check.remedy)):
        if text:
            paragraphs.append((" " * 9, " " * 11, f"{title}: {text}"))
    return "\n".join(
        textwrap.fill(
            text, WIDTH, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
        )
        for first, rest, text in paragraphs
    )
