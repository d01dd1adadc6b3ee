"""Commands that open the views of a report's pictures in 3D."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from attnwarp_eval.document.model import Gallery, Picture, Section, Slider
from attnwarp_eval.inspect.command import inspect_command
from attnwarp_eval.study.results import Results

FOLDER = "."
"""Path of the run in the commands: relative, for a shell in its folder wherever it is moved."""

COLORS = {
    "mask": "mask",
    "warped": None,
    "endpoint-error": "endpoint error",
    "depth-error": "depth error",
    "edited": "edit disagreement",
}
"""Pictures of a variant that can be inspected, and the colouring that explains each; None for the
command's default."""


def add_commands(results: Results, sections: Sequence[Section]) -> None:
    """Set the command of each picture of a variant in a target view; other pictures have none.

    Args:
        sections: sections with galleries, which also get one command per scene, for plain text.
    """
    commands = {path: (scene, command) for path, scene, command in _commands(results)}
    for gallery in (section.gallery for section in sections):
        if gallery is None:
            continue
        first: dict[str, str] = {}
        for picture in _pictures(gallery):
            if picture.path in commands:
                scene, picture.command = commands[picture.path]
                first.setdefault(scene, picture.command)
        gallery.commands = list(first.values())
    for grid in (grid for section in sections for grid in section.grids):
        for shown in (shown for _, row in grid.rows for shown in row):
            if shown is not None and shown.path in commands:
                shown.command = commands[shown.path][1]


def _commands(results: Results) -> Iterator[tuple[str, str, str]]:
    """Path of a picture, its scene, and its command."""
    study = results.study
    for cell in results.cells:
        variant = cell.variants[0]
        if (
            cell.record is None
            or cell.scene not in study.scene_names
            or variant not in study.variants
        ):
            continue
        # Views that are not targets of the scene, such as a fit's, cannot be opened.
        targets = cell.record.spec.get("views", [])
        for picture in cell.record.pictures:
            if picture.content in COLORS and picture.view.rpartition("/")[2] in targets:
                seed = cell.seed if len(study.seeds) > 1 else None
                command = inspect_command(
                    FOLDER, cell.scene, variant, picture.view,
                    seed=seed, color=COLORS[picture.content],
                )  # fmt: skip
                yield picture.path, cell.scene, command


def _pictures(gallery: Gallery) -> Iterator[Picture]:
    for _, entries in gallery.rows:
        for entry in entries:
            yield from [entry.before, entry.after] if isinstance(entry, Slider) else [entry]
