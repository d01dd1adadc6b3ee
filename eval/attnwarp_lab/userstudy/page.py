"""One self-contained page of two-way choices."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from attnwarp_eval.canonical_json import digest
from attnwarp_eval.document.write import reduced, reduction, templates
from attnwarp_lab.userstudy.draw import SCRAMBLED, Choice, draw
from attnwarp_lab.userstudy.material import Item, of_views, scrambled

QUESTIONS = {
    "instruction": "Which one follows the instruction better?",
    "consistency": "Which one looks like the same object from all sides?",
    "quality": "Which one looks better?",
}
"""Questions by their names in the answers."""

FORMAT = 1
"""Version of the answers' file."""


@dataclass(frozen=True)
class Design:
    """Design of a user study.

    Attributes:
        questions: names of :data:`QUESTIONS`.
        plans: number of different draws; each person gets one.
        choices: number of choices of a person.
        checks: number of attention checks of a person, besides the choices.
        seed: seed of all random draws.
    """

    questions: Sequence[str] = tuple(QUESTIONS)
    plans: int = 20
    choices: int = 30
    checks: int = 3
    seed: int = 0


def build_page(items: Sequence[Item], design: Design, title: str) -> str:
    """The page as HTML, with every picture inside it.

    Args:
        items: items of :func:`attnwarp_lab.userstudy.material.read_items`.

    Raises:
        InputError: a picture's file is missing.
    """
    plans = draw(
        [list(item.methods) for item in items],
        design.questions,
        plans=design.plans,
        choices=design.choices,
        checks=design.checks,
        seed=design.seed,
    )
    files: dict[str, bytes] = {}

    def named(pictures: Sequence[bytes]) -> list[str]:
        names = [hashlib.sha256(data).hexdigest()[:16] for data in pictures]
        files.update(zip(names, pictures, strict=True))
        return names

    entries = []
    for number, item in enumerate(items):
        sides = {name: of_views(item, own) for name, own in item.methods.items()}
        checks = [c for plan in plans for c in plan if c.is_check and c.item == number]
        if checks:
            first = next(iter(sides.values()))
            sides[SCRAMBLED] = [scrambled(data, design.seed) for data in first]
        entries.append(
            {
                **{key: getattr(item, key) for key in ("scene", "edit", "seed", "instruction")},
                "before": named(of_views(item, item.before)),
                "sides": {name: named(pictures) for name, pictures in sides.items()},
            }
        )
    study: dict[str, Any] = {
        "format": FORMAT,
        "title": title,
        "questions": {name: QUESTIONS[name] for name in design.questions},
        "items": entries,
        "plans": [[_row(choice) for choice in plan] for plan in plans],
    }
    study["study"] = digest(study)
    scale = reduction(sum(map(len, files.values())))
    study["pictures"] = {
        name: "data:image/jpeg;base64,"
        + base64.b64encode(reduced(data, scale) if scale < 1 else data).decode()
        for name, data in files.items()
    }
    environment = templates("attnwarp_lab.userstudy", autoescape=True)
    return environment.get_template("page.html.j2").render(study=study) + "\n"


def _row(choice: Choice) -> list[Any]:
    return list(asdict(choice).values())
