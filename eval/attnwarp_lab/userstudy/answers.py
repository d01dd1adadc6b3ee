"""The files of answers that the page saves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from attnwarp.errors import InputError
from attnwarp_lab.userstudy.draw import SCRAMBLED
from attnwarp_lab.userstudy.page import FORMAT


class Answer(BaseModel):
    """One choice of a person; an attention check has an obviously worse side."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str
    edit: str
    seed: int
    question: str
    left: str
    right: str
    chosen: Literal["left", "right"]
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]

    @property
    def pair(self) -> tuple[str, str]:
        """(chosen, other) method."""
        return (self.left, self.right) if self.chosen == "left" else (self.right, self.left)

    @property
    def is_check(self) -> bool:
        """True if it is an attention check."""
        return SCRAMBLED in (self.left, self.right)


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1]
    study: str
    title: str
    person: Annotated[str, Field(min_length=1)]
    plan: int
    planned: Annotated[int, Field(ge=0)]
    choices: list[Answer]


@dataclass(frozen=True)
class Person:
    """The answers of one person.

    Attributes:
        name: random name from the page.
        path: path of the file.
        study, title: study and title of the page.
        choices: choices made, without attention checks.
        checks: attention checks.
    """

    name: str
    path: Path
    study: str
    title: str
    choices: tuple[Answer, ...]
    checks: tuple[Answer, ...]

    @property
    def failed(self) -> int:
        """Attention checks in which the scrambled side was chosen."""
        return sum(check.pair[0] == SCRAMBLED for check in self.checks)


def read_answers(paths: Sequence[Path]) -> tuple[list[Person], list[str]]:
    """Read all answers; also return lines on files that were left out.

    Of several files by one person the longest counts.

    Raises:
        InputError: a file that is not from the page, or from another page than the first.
    """
    people: dict[str, Person] = {}
    notes = []
    for path in paths:
        person = _read(path)
        first = next(iter(people.values()), person)
        if person.study != first.study:
            raise InputError(
                f"{path}: answers of another page than {first.path}; score the answers of each"
                " page apart"
            )
        other = people.get(person.name)
        if other is not None:
            short, person = sorted((other, person), key=lambda one: len(one.choices))
            notes.append(f"{short.path}: left out, as {person.path} has the same person's answers")
        people[person.name] = person
    return list(people.values()), notes


def _read(path: Path) -> Person:
    try:
        read = _File.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; name files that the page saved") from None
    except ValidationError as error:
        problem = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(map(str, problem["loc"])) or "file"
        raise InputError(
            f"{path}: {place}: {problem['msg']}; expected answers of format {FORMAT} that a page"
            " of 'userstudy build' saved"
        ) from None
    for k, answer in enumerate(read.choices):
        if answer.left == answer.right:
            raise InputError(f"{path}: choices.{k}: both sides are {answer.left!r}; delete it")
    return Person(
        read.person,
        path,
        read.study,
        read.title,
        tuple(answer for answer in read.choices if not answer.is_check),
        tuple(answer for answer in read.choices if answer.is_check),
    )
