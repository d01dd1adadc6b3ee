"""Populations of scenes, defined by a generator, a seed and a number."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, ValidationError, model_validator

from attnwarp.errors import InputError
from attnwarp.process import cache_dir
from attnwarp_eval.cache import content_key
from attnwarp_eval.drawn.axes import check_axes
from attnwarp_eval.drawn.files import write
from attnwarp_eval.drawn.meshes import LONGEST_EDGE, MeshDraft, mesh_files
from attnwarp_eval.drawn.scenes import Drawn, draw
from attnwarp_eval.scene.base import Spec
from attnwarp_eval.scene.explain import explain

Count = Annotated[int, Field(ge=1, le=10_000)]


class _Scenes(Spec, ABC):
    """Keys of every population."""

    generator: Literal[1] = 1
    seed: Annotated[int, Field(ge=0, lt=2**32)]
    axes: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known_axes(self) -> Self:
        check_axes(self.axes)
        return self

    word: ClassVar[str]
    """First word of the scenes' names."""

    _number: ClassVar[str]
    """Key with the number of scenes."""

    @property
    def count(self) -> int:
        """Number of scenes."""
        number: int = getattr(self, self._number)
        return number

    @abstractmethod
    def scene(self, number: int) -> Drawn:
        """Draw one scene."""

    @abstractmethod
    def _what(self) -> str:
        """Number and kind of the scenes, in words."""

    def _decided_by(self) -> Any:
        """Further inputs that decide the scenes, besides the population's keys."""
        return None

    @property
    def words(self) -> str:
        """The population in words, for a report."""
        fixed = "".join(f", {name} {value:g}" for name, value in self.axes.items())
        return f"{self._what()} by generator {self.generator}, seed {self.seed}{fixed}"

    @property
    def names(self) -> list[str]:
        """Names of the scenes."""
        return [f"{self.word}-{k}" for k in range(self.count)]

    def scenes(self) -> Iterator[Drawn]:
        """Draw the scenes, one at a time."""
        for k in range(self.count):
            yield self.scene(k)

    def sized(self, count: int) -> Self:
        """Copy of the population with another number of scenes."""
        return self.model_copy(update={self._number: count})

    def paths(self) -> dict[str, Path]:
        """Files of the scenes by name, some of which may not be drawn yet."""
        kept = self.model_dump(mode="json")
        kept.pop(self._number)  # a larger population has the scenes of a smaller one
        folder = cache_dir() / "drawn" / content_key(kept, self._decided_by())[:16]
        return {name: folder / f"{name}.yaml" for name in self.names}

    def files(self, names: Container[str] | None = None) -> list[Path]:
        """Files of the named or of all scenes, drawn if missing; they may be deleted at any time."""
        paths = self.paths()
        for k, (name, path) in enumerate(paths.items()):
            if (names is None or name in names) and not path.is_file():
                write(self.scene(k), path.parent)
        return [path for name, path in paths.items() if names is None or name in names]


class DrawnScenes(_Scenes):
    """Scenes of a generator: ``scenes: {drawn: 48, generator: 1, seed: 7}`` in a study.

    Attributes:
        drawn: number of scenes, numbered from 0.
        generator: number of the generator; only 1 exists.
        seed: two seeds share no scene.
        axes: fixed positions on axes of difficulty; the others are drawn.
        shapes: whether the scenes' edits change shapes.

    Example:
        >>> population = DrawnScenes(drawn=2, seed=7, axes={"things": 3})
        >>> population.words
        '2 scenes drawn by generator 1, seed 7, things 3'
        >>> [len(scene.things) for scene in population.scenes()]
        [3, 3]
    """

    drawn: Count
    shapes: bool = False
    word: ClassVar[str] = "drawn"
    _number: ClassVar[str] = "drawn"

    def _what(self) -> str:
        return f"{self.drawn} scenes drawn"

    def scene(self, number: int) -> Drawn:
        """Draw one scene."""
        return draw(number, self.seed, self.axes, self.shapes)


class MeshScenes(_Scenes):
    """Other people's meshes on drawn ground: ``scenes: {meshes: FOLDER, n: 12, seed: 7}``.

    Attributes:
        meshes: folder of GLB or PLY files.
        n: number of scenes, numbered from 0.
        up: upright axis of all files; y if left out.
    """

    meshes: str
    n: Count
    up: Literal["y", "z"] | None = None
    word: ClassVar[str] = "mesh"
    _number: ClassVar[str] = "n"

    @property
    def _paths(self) -> list[Path]:
        return mesh_files(Path(self.meshes).expanduser())

    def _what(self) -> str:
        return f"{self.n} scenes of meshes of {Path(self.meshes).name} drawn"

    def _decided_by(self) -> Any:
        files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in self._paths}
        return LONGEST_EDGE, files

    def scene(self, number: int) -> Drawn:
        """Draw one scene."""
        return MeshDraft(
            number, self.seed, self.axes, meshes=self._paths, up=self.up or "y"
        ).finished()


Population = DrawnScenes | MeshScenes


def population(data: Any) -> Population:
    """The population that a study's ``scenes`` or a command names.

    Raises:
        InputError: an unknown key or a value out of range.

    Example:
        >>> population({"drawn": 0, "seed": 7})
        Traceback (most recent call last):
        attnwarp.errors.InputError: drawn: got 0, but input should be greater than or equal to 1
    """
    kind = MeshScenes if isinstance(data, Mapping) and "meshes" in data else DrawnScenes
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        texts = [explain(problem, kind, "docs/truth/drawn-scenes.md") for problem in problems]
        raise InputError("; ".join(texts)) from None
