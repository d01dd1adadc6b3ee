"""Entries of records on the ideal editor, which its probes share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import ClassVar, Self

from attnwarp_eval.study.record import Json
from attnwarp_eval.study.schema import Study, Variant
from attnwarp_eval.study.shared.edits import editor_of


@dataclass(frozen=True)
class EditorResult:
    """Entries of a cell's record on the ideal editor, besides the figures of its views.

    Attributes:
        share: share of signal, solved from the editor's ``settled``.
        settled, frequencies, agreement: settled, frequencies and agreement of views edited alone,
            :class:`attnwarp_lab.ideal.share.Alone`.
        fault: reason why the editor is not ideal; None if it is ideal.
        answers: answers of each part or place in the source's edit, -1 where it shows none.
    """

    entry: ClassVar[str]
    share: float
    settled: float
    frequencies: tuple[float, ...]
    agreement: float
    fault: str | None
    answers: tuple[int, ...]

    def to_json(self) -> Json:
        """The record's entry."""
        return {self.entry: asdict(self)}

    @classmethod
    def from_json(cls, data: Json) -> Self:
        """Rebuild from the record."""
        own = data[cls.entry].items()
        given: Json = {key: tuple(of) if isinstance(of, list) else of for key, of in own}
        return cls(**given)


def with_ideal_editor(study: Study, probe: str) -> Iterator[tuple[str, Variant]]:
    """Variants of a probe by name, each of which must have the ideal editor.

    Raises:
        ValueError: a variant has another editor.
    """
    for name in study.probes.get(probe, []):
        if editor_of(study, study.variants[name]).ideal is None:
            raise ValueError(
                f"probes.{probe}: {name!r} has no ideal editor; give it editor: {{ideal: {{}}}}"
            )
        yield name, study.variants[name]
