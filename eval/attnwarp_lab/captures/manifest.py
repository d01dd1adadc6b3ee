"""A manifest: captures, edits, variants and weights, in one YAML file or on a command line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Field,
    StringConstraints,
    ValidationError,
    field_validator,
)

from attnwarp.errors import InputError, suggest
from attnwarp_eval.plugins import load_plugins
from attnwarp_eval.scene import explain
from attnwarp_eval.scene.yaml import Place, YamlError, line_of, read_yaml
from attnwarp_eval.study.schema import Part, Whole
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS

SHIPPED = Path(__file__).parent / "shipped"
"""Folder of the bundled manifests."""

FIGURES = {
    "Edit PSNR": "Edit PSNR, mean of the views",
    "CLIP": "CLIP similarity",
    "CLIP dir": "CLIP directional similarity",
    "DINO img": "DINO single-image similarity",
    "CLIP img": "CLIP single-image similarity",
}
"""Columns of the paper's tables: heading -> title of :mod:`attnwarp_eval.user_images`."""

AUTHORS = {"clip": "clip-whole", "dino": "dinov2-518", "perceptual": "lpips"}
"""Schemes of encoders in folders, with the preprocessing of the paper's authors."""

KEYS = "docs/measuring/captures.md"
"""File that documents the keys."""

Words = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]


def _file_name(name: str) -> str:
    if name in ("", "..") or PurePath(name).name != name or not name.isprintable():
        raise ValueError(
            f"got the name {name!r}, expected one that a file can have, without a slash"
        )
    return name


Name = Annotated[str, AfterValidator(_file_name)]
"""Name used in file paths."""


class Edit(Part):
    """Descriptions of an edit.

    ``instruction`` is for InstructPix2Pix, ``controlnet`` for a ControlNet;
    ``source`` and ``target`` describe the scene before and after, for CLIP and for inversions.
    ``ours`` names the unpublished descriptions.
    """

    instruction: Words
    controlnet: Words | None = None
    source: Words | None = None
    target: Words | None = None
    ours: list[Literal["instruction", "controlnet", "source", "target"]] = Field(
        default_factory=list
    )

    def text(self, guide: str) -> str:
        """The words for an editor with a guide, "picture" or "depth"."""
        if guide == "picture":
            return self.instruction
        return self.controlnet or self.target or self.instruction


class MaskPart(Part):
    """Marks of the edited part, one of these: a folder of masks by the views' names; or, for the
    source view, a mask, a box, x, y of points, or words with the segmenter that finds them."""

    folder: str | None = None
    source: str | None = None
    box: tuple[float, float, float, float] | None = None
    at: tuple[float, ...] | None = None
    words: str | None = None
    segmenter: str = "clip-parts"


class Capture(Part):
    """A scene: posed pictures, splats of it, and edits.

    ``data`` is a transforms.json, or a folder with one, of COLMAP or of BlendedMVS; ``splats`` are
    files by kind; a missing kind is fitted.
    """

    data: str
    images: str | None = None
    scale: Whole = 1
    source: str | None = None
    splats: dict[Literal["2d", "3d"], str] = Field(default_factory=dict)
    mask: MaskPart | None = None
    edits: Annotated[dict[Words, Edit], Field(min_length=1)]


class Encoders(Part):
    """Encoders of the figures, and the perceptual distance, which also tunes splats."""

    clip: str = "clip-small"
    dino: str = "dino-small"
    perceptual: str = "perceptual-small"


class Row(Part):
    """A variant: a method with its settings, a row of a table.

    ``budget`` limits the method; ``paper`` has its published figures in the order of
    :data:`FIGURES`.
    """

    method: str = "attention_warping"
    preset: str | None = None
    options: dict[str, Any] = Field(default_factory=dict)
    editor: str
    splats: Literal["2d", "3d"] = "2d"
    seeds: list[Whole] | None = None
    budget: dict[str, Any] = Field(default_factory=dict)
    paper: list[float] | None = None

    @field_validator("paper")
    @classmethod
    def _all_figures(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and len(value) != len(FIGURES):
            raise ValueError(f"got {len(value)} figures, expected {', '.join(FIGURES)}")
        return value


class Manifest(Part):
    """Everything that decides a run on captures."""

    format: Literal[1]
    title: str
    size: Annotated[Whole, Field(ge=16, le=4096)] | None = None
    max_size: Annotated[Whole, Field(ge=16)] | None = None
    captures: Annotated[dict[Name, Capture], Field(min_length=1)]
    fit: dict[str, Any] = Field(default_factory=dict)
    seeds: Annotated[list[Whole], Field(min_length=1)] = Field(default_factory=lambda: [0])
    editors: Annotated[dict[str, str], Field(min_length=1)]
    encoders: Encoders = Encoders()
    variants: Annotated[dict[str, Row], Field(min_length=1)]


@dataclass(frozen=True)
class Loaded:
    """A manifest, and the folder that its paths are relative to."""

    manifest: Manifest
    folder: Path

    def path(self, name: str) -> Path:
        """A path of the manifest."""
        return self.folder / Path(name).expanduser()

    def editor(self, name: str) -> str:
        """An editor of the manifest as :func:`attnwarp.editing.small.load_editor` takes it."""
        return _from(self.folder, self.manifest.editors[name])

    def encoder(self, kind: Literal["clip", "dino", "perceptual"]) -> str:
        """An encoder as :func:`attnwarp_eval.encoders.load_encoder` takes it."""
        from attnwarp_eval.encoders import BUNDLED

        folder = str(getattr(self.manifest.encoders, kind))
        return folder if folder in BUNDLED else f"{AUTHORS[kind]}:{self.path(folder)}"

    def seeds(self, row: Row) -> list[int]:
        """Seeds of a row."""
        return self.manifest.seeds if row.seeds is None else row.seeds

    def edits(self) -> Iterator[tuple[str, str]]:
        """Yield every capture with each of its edits, by name."""
        for name, capture in self.manifest.captures.items():
            for edit in capture.edits:
                yield name, edit

    def changed(self, **changes: Any) -> Loaded:
        """A copy with other values of keys."""
        return Loaded(self.manifest.model_copy(update=changes), self.folder)

    def only(self, names: Sequence[str]) -> Loaded:
        """Restrict to some variants, with their editors.

        Raises:
            InputError: no such variant.
        """
        m = self.manifest
        for name in names:
            if name not in m.variants:
                raise InputError(
                    f"--variant: got {name!r}, expected one of {', '.join(m.variants)}"
                    f"{suggest(name, list(m.variants))}"
                )
        variants = {name: m.variants[name] for name in names}
        used = {row.editor for row in variants.values()}
        editors = {name: folder for name, folder in m.editors.items() if name in used}
        return self.changed(variants=variants, editors=editors)

    def with_editors(self, folders: Sequence[str]) -> Loaded:
        """Replace editors by others of their kind; other variants are dropped.

        Raises:
            InputError: no such editor, or no variant uses its kind.
        """
        from attnwarp.editing.small import guide_of

        m, given = self.manifest, {guide_of(folder): folder for folder in folders}
        guides = {row.editor: guide_of(self.editor(row.editor)) for row in m.variants.values()}
        for guide in given.keys() - set(guides.values()):
            raise InputError(
                f"--editor {given[guide]}: is guided by a {guide}, and no variant takes one of that"
                " kind; leave it out"
            )
        editors = {
            name: _from(Path.cwd(), given[guide])
            for name, guide in guides.items()
            if guide in given
        }
        kept = [name for name, row in m.variants.items() if row.editor in editors]
        return self.changed(editors={**m.editors, **editors}).only(kept)


def _from(place: Path, editor: str) -> str:
    """A bundled editor's name, or its folders resolved from ``place``."""
    from attnwarp.editing.small import bundled

    if editor in bundled():
        return editor
    return ",".join(str(place / Path(part.strip()).expanduser()) for part in editor.split(","))


def shipped() -> dict[str, Path]:
    """Bundled manifests by name.

    Example:
        >>> list(shipped())
        ['one', 'paper']
    """
    return {path.stem: path for path in sorted(SHIPPED.glob("*.yaml"))}


def load_manifest(name_or_path: str, one: Mapping[str, Any] | None = None) -> Loaded:
    """Read a manifest by the name of a shipped one or by a file's path.

    Its paths are relative to the file's folder; those of a bundled one to the current folder.

    Args:
        name_or_path: name or path of the manifest.
        one: keys that replace the manifest's, such as the capture of a command line; published
            figures are then not compared.

    Raises:
        InputError: no such file, invalid YAML, another version, a duplicate, missing or
            unknown key, or a value out of range; the message names the place and the remedy.

    Example:
        >>> try:
        ...     load_manifest("papr")
        ... except InputError as error:
        ...     print(error)
        papr: no such manifest; did you mean 'paper'? Or give the path of a YAML file
    """
    own = shipped()
    path = own.get(name_or_path, Path(name_or_path))
    if not path.is_file():
        hint = suggest(name_or_path, list(own))
        raise InputError(
            f"{name_or_path}: no such manifest{f'{hint} Or' if hint else '; or'} give the path of"
            " a YAML file"
        )
    try:
        lines, data = read_yaml(path.read_text(encoding="utf-8"))
    except (YamlError, UnicodeDecodeError) as error:
        line = getattr(error, "line", None)
        raise InputError(f"{path}{f':{line}' if line else ''}: {error}") from None
    try:
        manifest = Manifest.model_validate(
            {**data, **(one or {})} if isinstance(data, dict) else data
        )
    except ValidationError as error:
        raise InputError(
            "\n".join(
                f"{path}:{line_of(lines, problem['loc'])}: "
                f"{explain.explain(problem, Manifest, KEYS)}"
                for problem in error.errors(include_url=False)
            )
        ) from None
    loaded = Loaded(manifest, Path() if name_or_path in own else path.parent)
    if one is not None:
        kinds = [kind for capture in manifest.captures.values() for kind in capture.splats]
        own_keys = {"paper": None, **({"splats": kinds[0]} if kinds else {})}
        rows = manifest.variants.items()
        loaded = loaded.changed(variants={k: row.model_copy(update=own_keys) for k, row in rows})
    _check_names(path, lines, loaded.manifest)
    return loaded


def _check_names(path: Path, lines: dict[Place, int], manifest: Manifest) -> None:
    """Refuse unknown names, and settings that no method has."""
    from attnwarp.fit import FitSettings
    from attnwarp.methods import Budget

    def known(place: str, name: str, names: list[str]) -> None:
        if name not in names:
            raise InputError(
                f"{path}: {place}: got {name!r}, expected one of {', '.join(names)}"
                f"{suggest(name, names)}"
            )

    load_plugins()
    methods = [name for name, method in EDITING_METHODS.items() if not method.needs_truth]
    for name, row in manifest.variants.items():
        known(f"variants.{name}.editor", row.editor, list(manifest.editors))
        known(f"variants.{name}.method", row.method, methods)
        for key in ("seed", "size", "perceptual_encoder"):
            if key in row.options:
                raise InputError(
                    f"{path}: variants.{name}.options.{key}: is the manifest's own; leave it out"
                )
        try:
            EDITING_METHODS[row.method].settings(row.preset, row.options, 0)
            Budget.from_dict(row.budget)
        except (TypeError, ValueError) as error:
            raise InputError(f"{path}: variants.{name}: {error}") from None
    try:
        FitSettings.from_dict(manifest.fit)
    except ValueError as error:
        raise InputError(f"{path}: fit: {error}") from None
