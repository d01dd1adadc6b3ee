"""Commands about people: a page of two-way choices, and the score of their answers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from attnwarp.cli.options import option
from attnwarp.cli.shell import App, fail
from attnwarp_eval.cli.shell import TOO_LITTLE, check_not_of_run, clear_errors, names

app = App(
    help="Ask people which edited scene they prefer, and score their answers.",
    no_args_is_help=True,
)


@app.command()
def build(
    run: Annotated[Path, typer.Argument(help="The folder of a run that edited scenes.")],
    out: Annotated[Path, option("Write the page to this file.", "FILE")] = Path("userstudy.html"),
    method: Annotated[
        list[str] | None,
        option("Show this variant; may be repeated (default all with pictures).", "NAME"),
    ] = None,
    questions: Annotated[
        str | None,
        option(
            "Ask these questions, with commas between: instruction, consistency, quality (default"
            " all).",
            "NAMES",
        ),
    ] = None,
    choices: Annotated[int, option("Ask each person for so many choices.", "N", min=1)] = 30,
    checks: Annotated[int, option("Give each person so many attention checks.", "N", min=0)] = 3,
    plans: Annotated[
        int,
        option("Draw so many plans; each person gets one at random.", "N", min=1),
    ] = 20,
    seed: Annotated[int, option("Draw the plans from this seed.", "N", min=0)] = 0,
    title: Annotated[
        str, option("Show this title on the page.", "WORDS")
    ] = "Which edit do you prefer?",
) -> None:
    """Make one self-contained page of two-way choices between the methods of a run.

    It works offline, on a phone too. Answers are saved as a JSON file; nothing is sent.
    """
    from attnwarp.errors import InputError, suggest
    from attnwarp_eval.files import write_atomic
    from attnwarp_lab.userstudy.material import read_items
    from attnwarp_lab.userstudy.page import QUESTIONS, Design, build_page

    with clear_errors():
        asked = list(QUESTIONS) if questions is None else names(questions) or []
        for name in asked or [""]:
            if name not in QUESTIONS or asked.count(name) > 1:
                raise InputError(
                    f"--questions: got {questions!r}, expected different ones of"
                    f" {', '.join(QUESTIONS)}{suggest(name, list(QUESTIONS))}"
                )
        check_not_of_run(out, run)
        items = read_items(run, method)
        text = build_page(items, Design(asked, plans, choices, checks, seed), title)
        write_atomic(out, text.encode())
    compared = dict.fromkeys(name for item in items for name in item.methods)
    typer.echo(f"{len(items)} edited scenes, methods {', '.join(compared)}")
    typer.echo(f"{out}: {len(text) / 1e6:.1f} MB")


@app.command()
def score(
    answers: Annotated[
        list[Path], typer.Argument(metavar="ANSWERS...", help="Files that people saved.")
    ],
    out: Annotated[
        Path | None,
        option("Write preferences.md and .html to this folder.", "FOLDER"),
    ] = None,
) -> None:
    """Score each method by its selections, with intervals, and name who failed attention checks."""
    from rich.console import Console

    from attnwarp.cli.shell import check_out
    from attnwarp_eval.document import write
    from attnwarp_lab.userstudy.answers import read_answers
    from attnwarp_lab.userstudy.score import report, score

    with clear_errors():
        if out is not None:
            check_out(out)
        people, notes = read_answers(answers)
        try:
            result = score(people)
        except ValueError as error:
            raise fail(f"{error}", TOO_LITTLE) from None
        document = report(result)
        console = Console()
        for line in document.lead:
            typer.echo(line.replace("**", ""))
        for section in document.sections:
            typer.echo(f"\n{section.title}")
            for table in section.tables:
                console.print(write.terminal(table))
        for note in notes:
            typer.echo(note, err=True)
        if out is not None:
            for path in write.write_files(document, out, "preferences"):
                typer.echo(path)
