"""A cell: one scene, one variant, one seed, one probe. Its id is the hash of its spec."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from attnwarp_eval.canonical_json import digest


@dataclass(frozen=True)
class Cell:
    """One unit of work.

    Attributes:
        spec: all inputs that decide the result, and no others: scene content, variant content,
            seed, views, image size, protocol versions. User-given names are left out.
        scene, variant, probe, seed: labels for tables and error messages. For a probe that needs no
            scenes, ``scene`` names its subject, such as a hard case.
        labels: variant names with this content.
        pictures: views whose pictures are saved.
        sources: locations of inputs that ``spec`` names by content, such as encoders.
    """

    spec: dict[str, Any]
    scene: str
    variant: str
    probe: str
    seed: int
    labels: tuple[str, ...] = field(default=())
    pictures: tuple[str, ...] = field(default=())
    sources: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def id(self) -> str:
        """SHA-256 of the canonical JSON of ``spec``."""
        return digest(self.spec)

    @property
    def scene_file(self) -> str:
        """Name or path of the cell's scene, for :func:`attnwarp_eval.scene.file.load_scene`."""
        return self.sources.get("scene", self.scene)

    @property
    def title(self) -> str:
        """Short text for progress bars and failure tables."""
        return f"{self.scene} / {self.variant} / {self.probe}" + (
            f" / seed {self.seed}" if self.seed else ""
        )


def merged(cells: Iterable[Cell]) -> list[Cell]:
    """Cells in order; cells of the same content are merged, with the labels of all."""
    by_id: dict[str, Cell] = {}
    for cell in cells:
        first = by_id.get(cell.id)
        by_id[cell.id] = (
            cell
            if first is None
            else replace(
                first,
                labels=(*first.labels, *cell.labels),
                pictures=first.pictures or cell.pictures,
            )
        )
    return list(by_id.values())
