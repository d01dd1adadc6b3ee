"""Pydantic's errors as actionable lines: the key in YAML's notation, the value, the expected value,
and the nearest valid key.
"""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel

from attnwarp.errors import suggest


def explain(problem: Any, model: type[BaseModel], file: str) -> str:
    """Format one of a ValidationError's errors in one line.

    Args:
        problem: an item of ``ValidationError.errors()``.
        file: name of the documentation of the keys.

    Example:
        >>> from pydantic import BaseModel, Field, ValidationError
        >>> class Ball(BaseModel):
        ...     radius: float = Field(gt=0)
        >>> try:
        ...     Ball(radius=0)
        ... except ValidationError as error:
        ...     print(explain(error.errors()[0], Ball, "docs/truth/scenes.md"))
        radius: got 0, but input should be greater than 0
    """
    place, _ = _follow(problem["loc"], model)
    kind, came = problem["type"], problem.get("input")
    if kind == "extra_forbidden":
        _, owner = _follow(problem["loc"][:-1], model)
        allowed = list(owner.model_fields) if owner else []
        key = str(problem["loc"][-1])
        return (
            f"{place}: unknown key {key!r}{suggest(key, allowed)}; allowed here:"
            f" {', '.join(allowed)}"
        )
    if kind == "missing":
        return f"{place}: is missing; add it ({file} says what each key means)"
    if kind == "union_tag_invalid":
        came, allowed = (
            problem["ctx"]["tag"],
            [tag.strip("' ") for tag in problem["ctx"]["expected_tags"].split(",")],
        )
        return (
            f"{place}.type: got {came!r}{suggest(came, allowed)}; expected one of"
            f" {', '.join(allowed)}"
        )
    if kind == "union_tag_not_found":
        return f"{place}: says no type; add 'type: ...' (docs/truth/scenes.md lists the types)"
    if kind == "value_error":  # from this package's validators, whose messages are complete
        message = problem["msg"].removeprefix("Value error, ")
        return f"{place}: {message}" if place else message
    message = problem["msg"]
    return f"{place or 'the file'}: got {reprlib.repr(came)}, but {message[0].lower()}{message[1:]}"


def _follow(loc: Sequence[int | str], model: type[BaseModel]) -> tuple[str, type[BaseModel] | None]:
    """A pydantic location as a YAML key path, and the model at its end.

    Unions put the tag of the chosen member into the location; it selects the model and is left
    out of the path.
    """
    place = ""
    annotation: Any = model
    for step in loc:
        if isinstance(step, int):
            place += f"[{step}]"
            continue
        models = _models(annotation)
        tagged = [m for m in models if len(models) > 1 and step in _tags(m)]
        if tagged:
            annotation = tagged[0]
            continue
        if not models and get_origin(annotation) in (Union, UnionType):
            continue  # pydantic's name of a member, such as constrained-int
        place += f".{step}" if place else step
        if get_origin(annotation) is dict:
            annotation = get_args(annotation)[1]
            continue
        annotation = next(
            (m.model_fields[step].annotation for m in models if step in m.model_fields), None
        )
    models = _models(annotation)
    return place, models[0] if len(models) == 1 else None


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    """Values that a member of a union may have as its type."""
    field = model.model_fields.get("type")
    return () if field is None else get_args(field.annotation)


def _models(annotation: Any) -> list[type[BaseModel]]:
    """The models in an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]
