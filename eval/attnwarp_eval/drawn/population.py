"""Populations of scenes: which scenes a study means by a generator, a seed and a number."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from attnwarp.errors import InputError
from attnwarp.process import cache_dir
from attnwarp_eval.cache import content_key
from attnwarp_eval.drawn.axes import check_axes, spread
from attnwarp_eval.drawn.files import write
from attnwarp_eval.drawn.scenes import Drawn, draw
from attnwarp_eval.scene.base import Spec
from attnwarp_eval.scene.explain import explain

OTHER_SEED = 1_000_003
"""Added to a population's seed for its pilot, which must have other scenes."""

Count = Annotated[int, Field(ge=1, le=10_000)]


class DrawnScenes(Spec):
    """Scenes of a generator: ``scenes: {drawn: 48, generator: 1, seed: 7}`` in a study.

    Attributes:
        drawn: how many, numbered from 0.
        generator: its number; there is one.
        seed: two seeds share no scene.
        axes: places on axes of difficulty that all of them have; the others are drawn.
        stratify: axes over which they are spread evenly.

    Example:
        >>> population = DrawnScenes(drawn=2, seed=7, axes={"things": 3})
        >>> population.words
        '2 scenes drawn by generator 1, seed 7, things 3'
        >>> [len(scene.things) for scene in population.scenes()]
        [3, 3]
    """

    drawn: Count
    generator: Literal[1] = 1
    seed: Annotated[int, Field(ge=0, lt=2**32)]
    axes: dict[str, float] = Field(default_factory=dict)
    stratify: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _known_axes(self) -> DrawnScenes:
        check_axes(self.axes, self.stratify)
        return self

    @property
    def count(self) -> int:
        """Number of scenes."""
        return self.drawn

    @property
    def word(self) -> str:
        """First word of the scenes' names."""
        return "drawn"

    def pilot(self, count: int) -> DrawnScenes:
        """A few scenes of another seed, drawn in the same way."""
        other = (self.seed + OTHER_SEED) % 2**32
        return self.model_copy(update={"drawn": count, "seed": other})

    @property
    def words(self) -> str:
        """The population in words, for a report."""
        text = f"{self.drawn} scenes drawn by generator {self.generator}, seed {self.seed}"
        fixed = "".join(f", {name} {value:g}" for name, value in self.axes.items())
        spreads = f", {' and '.join(self.stratify)} spread evenly" if self.stratify else ""
        return text + fixed + spreads

    @property
    def names(self) -> list[str]:
        """Names of the scenes."""
        return [f"{self.word}-{k}" for k in range(self.count)]

    def scenes(self) -> Iterator[Drawn]:
        """Draw them, one at a time."""
        for k in range(self.count):
            yield self.scene(k)

    def scene(self, number: int) -> Drawn:
        """Draw one of them."""
        places = {name: spread(name, self.drawn, self.seed)[number] for name in self.stratify}
        return draw(number, self.seed, {**self.axes, **places})

    def files(self) -> list[Path]:
        """Files of the scenes, drawn where they are missing; they may be deleted at any time."""
        kept = self.model_dump(mode="json")
        if not self.stratify:
            kept.pop("drawn")  # a larger population has the scenes of a smaller one
        folder = cache_dir() / "drawn" / content_key(kept)[:16]
        paths = [folder / f"{name}.yaml" for name in self.names]
        for k, path in enumerate(paths):
            if not path.is_file():
                write(self.scene(k).data, folder)
        return paths


def population(data: Any) -> DrawnScenes:
    """The population that a study's ``scenes`` or a command names.

    Raises:
        InputError: an unknown key or a value out of range.

    Example:
        >>> population({"drawn": 0, "seed": 7})
        Traceback (most recent call last):
        attnwarp.errors.InputError: drawn: got 0, but input should be greater than or equal to 1
    """
    try:
        return DrawnScenes.model_validate(data)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        texts = [
            explain(problem, DrawnScenes, "docs/truth/drawn-scenes.md") for problem in problems
        ]
        raise InputError("; ".join(texts)) from None
