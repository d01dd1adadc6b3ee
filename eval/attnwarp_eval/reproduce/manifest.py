"""A manifest: everything that decides a reproduction, in one YAML file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, field_validator

from attnwarp.errors import InputError, suggest
from attnwarp_eval.files import write_atomic
from attnwarp_eval.scene import explain
from attnwarp_eval.scene.yaml import YamlError, line_of, read_yaml
from attnwarp_eval.study.schema import Part, Whole

VERSION = 1
"""Version of manifests that this code reads."""

SHIPPED = Path(__file__).parent / "shipped"
"""Folder of the manifests that ship with the package."""

FIGURES = {
    "Edit PSNR": "Edit PSNR, mean of the views",
    "CLIP": "CLIP similarity",
    "CLIP dir": "CLIP directional similarity",
    "DINO img": "DINO single-image similarity",
    "CLIP img": "CLIP single-image similarity",
}
"""Columns of the paper's tables: their heads -> titles of :mod:`attnwarp_eval.user_images`."""

KEYS = "docs/measuring/reproducing.md"
"""File that says what each key means."""

Words = Annotated[str, Field(min_length=1), BeforeValidator(lambda v: v.strip() if v else v)]


def _file_name(name: str) -> str:
    if name in ("", "..") or PurePath(name).name != name or not name.isprintable():
        raise ValueError(
            f"got the name {name!r}, expected one that a file can have, without a slash"
        )
    return name


Name = Annotated[str, AfterValidator(_file_name)]
"""Name that becomes part of the paths of files."""


class Edit(Part):
    """Four descriptions of an edit.

    ``instruction`` is what InstructPix2Pix is told, ``controlnet`` what a ControlNet is told;
    ``source`` and ``target`` describe the scene before and after, for CLIP and for inversions.
    ``ours`` names those that were not published.
    """

    instruction: Words
    controlnet: Words
    source: Words
    target: Words
    ours: list[Literal["instruction", "controlnet", "source", "target"]] = Field(
        default_factory=list
    )


class MaskPart(Part):
    """Marks of what is edited, one of these: a folder of masks by the views' names, a mask of the
    source view, or words and the segmenter that looks for them."""

    folder: str | None = None
    source: str | None = None
    words: str | None = None
    segmenter: str = "clip-parts"


class Capture(Part):
    """A scene: posed pictures, splats of it, and edits.

    ``data`` is a transforms.json, or a folder of one, of COLMAP or of BlendedMVS; ``splats`` are
    files by their kind, and a kind that is left out is fitted.
    """

    data: str
    images: str | None = None
    scale: Whole = 1
    source: str | None = None
    splats: dict[Literal["2d", "3d"], str] = Field(default_factory=dict)
    mask: MaskPart | None = None
    edits: Annotated[dict[Name, Edit], Field(min_length=1)]


class Weights(Part):
    """Weights in a folder, and what tells them from others.

    ``shapes`` are of some tensors by name; ``probe`` is the value that ``--dry-run`` prints, and
    ``sha256`` the hash of the files. The latter two are recorded where they are left out.
    """

    folder: str
    shapes: dict[str, list[int]] = Field(default_factory=dict)
    probe: float | None = None
    sha256: str | None = None
    scheduler: Literal["stable-diffusion", "any"] = "stable-diffusion"


class Encoders(Part):
    """Encoders of the figures, and the perceptual distance that splats are tuned with."""

    clip: Weights
    dino: Weights
    perceptual: Weights | None = None


class Row(Part):
    """A row of a table: a method with its settings.

    ``paper`` are its published figures in the order of :data:`FIGURES`.
    """

    method: str = "attention_warping"
    preset: str | None = None
    options: dict[str, Any] = Field(default_factory=dict)
    editor: str
    splats: Literal["2d", "3d"] = "2d"
    seeds: list[Whole] | None = None
    paper: list[float] | None = None

    @field_validator("paper")
    @classmethod
    def _all_figures(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and len(value) != len(FIGURES):
            raise ValueError(f"got {len(value)} figures, expected {', '.join(FIGURES)}")
        return value


class TablePart(Part):
    """A table: rows by name, and the row that verdicts compare the others with."""

    title: str
    rows: Annotated[list[str], Field(min_length=1)]
    against: str | None = None


class Manifest(Part):
    """Everything that decides a reproduction."""

    format: Literal[1]
    title: str
    size: Annotated[Whole, Field(ge=16, le=4096)] = 512
    max_size: Annotated[Whole, Field(ge=16)] | None = None
    captures: Annotated[dict[Name, Capture], Field(min_length=1)]
    fit: dict[str, Any] = Field(default_factory=dict)
    seeds: Annotated[list[Whole], Field(min_length=1)] = Field(default_factory=lambda: [0])
    editors: Annotated[dict[str, Weights], Field(min_length=1)]
    encoders: Encoders
    methods: Annotated[dict[str, Row], Field(min_length=1)]
    tables: list[TablePart] = Field(default_factory=list)
    geometry: Annotated[Whole, Field(ge=0)] = 3
    variability: list[str] = Field(default_factory=list)


@dataclass(frozen=True)
class Loaded:
    """A manifest, and the folder that its paths count from."""

    manifest: Manifest
    folder: Path

    def path(self, name: str) -> Path:
        """A path of the manifest."""
        return self.folder / Path(name).expanduser()

    def paths(self) -> list[Path]:
        """Paths of captures, splats, masks and weights; what is bundled has none."""
        names: list[str | None] = []
        for c in self.manifest.captures.values():
            mask = c.mask or MaskPart()
            names += [c.data, c.images, *c.splats.values(), mask.folder, mask.source]
        for weights in in_folders(self.manifest).values():
            names += [part.strip() for part in weights.folder.split(",")]
        return [self.path(name) for name in names if name is not None]

    def editor(self, name: str) -> str:
        """An editor of the manifest as :func:`attnwarp.editing.small.load_editor` takes it."""
        from attnwarp.editing.small import bundled

        folder = self.manifest.editors[name].folder
        if folder in bundled():
            return folder
        return ",".join(str(self.path(part.strip())) for part in folder.split(","))

    def encoder(self, kind: Literal["clip", "dino", "perceptual"]) -> str:
        """An encoder as :func:`attnwarp.encoders.load_encoder` takes it."""
        from attnwarp.encoders import BUNDLED

        weights = getattr(self.manifest.encoders, kind)
        if weights is None:
            return "perceptual-small"
        scheme = {"clip": "clip", "dino": "dinov2", "perceptual": "lpips"}[kind]
        if weights.folder in BUNDLED:
            return str(weights.folder)
        return f"{scheme}:{self.path(weights.folder)}"

    def seeds(self, row: Row) -> list[int]:
        """Seeds of a row."""
        return self.manifest.seeds if row.seeds is None else row.seeds

    def edits(self) -> Iterator[tuple[str, str]]:
        """Every capture with each of its edits, by name."""
        for name, capture in self.manifest.captures.items():
            for edit in capture.edits:
                yield name, edit

    def quick(self) -> Loaded:
        """The first capture with its first edit, the first seed, and two methods: the row that
        the first table compares with, and another of the same editor."""
        m = self.manifest
        name, capture = next(iter(m.captures.items()))
        first = dict([next(iter(capture.edits.items()))])
        rows = m.tables[0].rows if m.tables else list(m.methods)
        against = (m.tables[0].against if m.tables else None) or rows[0]
        editor = m.methods[against].editor
        others = sorted(
            (r for r in rows if r != against), key=lambda r: m.methods[r].editor != editor
        )
        kept = [against, *others[:1]]
        methods = {r: m.methods[r].model_copy(update={"seeds": None}) for r in kept}
        table = TablePart(title="Quick look", rows=kept, against=against)
        used = {row.editor for row in methods.values()}
        return Loaded(
            m.model_copy(
                update={
                    "captures": {name: capture.model_copy(update={"edits": first})},
                    "methods": methods, "tables": [table], "seeds": m.seeds[:1],
                    "variability": [], "geometry": 0,
                    "editors": {k: v for k, v in m.editors.items() if k in used},
                }
            ),
            self.folder,
        )  # fmt: skip


def shipped() -> dict[str, Path]:
    """Manifests that ship with the package, by name.

    Example:
        >>> list(shipped())
        ['paper']
    """
    return {path.stem: path for path in sorted(SHIPPED.glob("*.yaml"))}


def load_manifest(name_or_path: str) -> Loaded:
    """Read a manifest by the name of a shipped one or by a file's path.

    Paths in it count from the file's folder; those of a shipped one from the current folder.

    Raises:
        InputError: no such file, no YAML, another version, a key that stands twice, is missing or
            unknown, or a value out of range; the message names the place and what to do.

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
    if not isinstance(data, dict) or data.get("format") != VERSION:
        got = data.get("format") if isinstance(data, dict) else None
        raise InputError(
            f"{path}: format: got {got!r}, expected {VERSION}: the manifest is of another version;"
            " write it anew after docs/measuring/reproducing.md"
        )
    try:
        manifest = Manifest.model_validate(data)
    except ValidationError as error:
        raise InputError(
            "\n".join(
                f"{path}:{line_of(lines, problem['loc'])}: {_explained(problem, Manifest)}"
                for problem in error.errors(include_url=False)
            )
        ) from None
    _check_names(path, manifest)
    return Loaded(manifest, Path() if name_or_path in own else path.parent)


def write_probes(path: Path, probes: Mapping[str, float]) -> None:
    """Write probe values into a manifest, before the ``folder`` of what they are of.

    Args:
        path: path of the manifest; all else in it stays, comments too.
        probes: by key, such as ``editors.pix2pix``.

    Raises:
        InputError: the file's notation leaves no place that is sure; nothing is written.
    """
    text = path.read_text(encoding="utf-8")
    where, wanted = read_yaml(text)
    lines = text.splitlines(keepends=True)
    for key, value in probes.items():
        part, name = key.split(".", 1)
        wanted[part][name]["probe"] = float(f"{value:.6g}")
        number = where.get((part, name, "folder"), 1) - 1
        before, found, after = lines[number].partition("folder:")
        end = ", " if before.strip() else f"\n{before}"  # {folder: ...}, or a line of its own
        lines[number] = f"{before}probe: {value:.6g}{end}{found}{after}"
    changed = "".join(lines)
    try:
        same = read_yaml(changed)[1] == wanted
    except YamlError:
        same = False
    if not same:
        raise InputError(
            f"{path}: give each of {', '.join(probes)} a line `folder: ...` of its own"
        )
    write_atomic(path, changed.encode())


def in_folders(manifest: Manifest) -> dict[str, Weights]:
    """Weights that are not bundled, by key."""
    from attnwarp.editing.small import bundled
    from attnwarp.encoders import BUNDLED

    known = {*bundled(), *BUNDLED}
    encoders = {k: getattr(manifest.encoders, k) for k in ("clip", "dino", "perceptual")}
    named = {
        **{f"editors.{k}": w for k, w in manifest.editors.items()},
        **{f"encoders.{k}": w for k, w in encoders.items() if w is not None},
    }
    return {key: w for key, w in named.items() if w.folder not in known}


def lacking(manifest: Manifest) -> list[str]:
    """Keys of weights in folders that neither a probe value nor a hash tells from others."""
    weights = in_folders(manifest).items()
    return [key for key, w in weights if w.probe is None and w.sha256 is None]


def _explained(problem: Any, model: Any) -> str:
    loc = problem["loc"]
    missing = problem["type"] == "missing"
    if len(loc) == 5 and loc[2] == "edits" and (missing or not problem.get("input")):
        what = "is missing" if missing else "is empty"
        return (
            f"captures.{loc[1]}.edits.{loc[3]}.{loc[4]}: {what}, expected the words of this prompt;"
            " where the paper published none, write your own"
        )
    return explain.explain(problem, model, KEYS)


def _check_names(path: Path, manifest: Manifest) -> None:
    """Refuse names that nothing has, and settings that no method takes."""
    from attnwarp.fit import FitSettings
    from attnwarp.methods import preset

    def known(place: str, name: str, names: list[str]) -> None:
        if name not in names:
            raise InputError(
                f"{path}: {place}: got {name!r}, expected one of {', '.join(names)}"
                f"{suggest(name, names)}"
            )

    for name, row in manifest.methods.items():
        known(f"methods.{name}.editor", row.editor, list(manifest.editors))
        for key in ("seed", "size", "perceptual_encoder"):
            if key in row.options:
                raise InputError(
                    f"{path}: methods.{name}.options.{key}: is the manifest's own; leave it out"
                )
        try:
            preset(row.method, row.preset, **row.options)
        except (TypeError, ValueError) as error:
            raise InputError(f"{path}: methods.{name}: {error}") from None
    for number, table in enumerate(manifest.tables):
        named = [*table.rows, *([table.against] if table.against else [])]
        for name in named:
            known(f"tables.{number}", name, list(manifest.methods))
    for name in manifest.variability:
        known("variability", name, list(manifest.methods))
    try:
        FitSettings.from_dict(manifest.fit)
    except ValueError as error:
        raise InputError(f"{path}: fit: {error}") from None
