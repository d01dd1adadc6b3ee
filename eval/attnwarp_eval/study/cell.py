"""A cell: one scene, one variant, one seed, one probe. Its id is the hash of what it computes,
never of its name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from attnwarp_eval.files import digest


@dataclass(frozen=True)
class Cell:
    """One unit of work.

    Attributes:
        spec: everything that decides the result, and nothing else: scene content, variant content,
            seed, views, image size, protocol versions. The names that people gave to the variant
            are not in it.
        scene, variant, probe, seed: labels for tables and error messages.
        labels: every variant name that leads to this same content.
        pictures: views of which pictures are kept.
        encoders: by kind, the names that encoders are loaded by; which weights they are is in
            ``spec``.
    """

    spec: dict[str, Any]
    scene: str
    variant: str
    probe: str
    seed: int
    labels: tuple[str, ...] = field(default=())
    pictures: tuple[str, ...] = field(default=())
    encoders: dict[str, str] = field(default_factory=dict)

    @cached_property
    def id(self) -> str:
        """SHA-256 of the canonical JSON of ``spec``."""
        return digest(self.spec)

    @property
    def title(self) -> str:
        """Short text for progress bars and failure tables."""
        return f"{self.scene} / {self.variant} / {self.probe}" + (
            f" / seed {self.seed}" if self.seed else ""
        )
