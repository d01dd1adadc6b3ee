"""Metrics of a user's pictures, paired by name: the columns of the paper's table.

The metrics are pure functions of :mod:`attnwarp_eval.metrics`; this module reads the files.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from attnwarp.devices import device_of
from attnwarp.encoders import EncoderInfo, Kind
from attnwarp.errors import InputError
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval import metrics
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.encoders import check_kind, load_encoder
from attnwarp_eval.metrics.registry import METRICS
from attnwarp_eval.study.record import Json, with_nan
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.task import Task, results

Picture = npt.NDArray[np.float32]
Embedding = npt.NDArray[np.float64]

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")

DEFAULTS: dict[Kind, str] = {
    "clip": "clip-small",
    "dino": "dino-small",
    "perceptual": "perceptual-small",
}
"""Default encoders."""

OFF = "none"
"""Value that disables an encoder and its figures."""

BATCH = 4
"""Number of views held in memory together."""


@dataclass(frozen=True)
class Inputs:
    """The pictures and prompts. Each may be missing; figures that need it are then left out.

    Attributes:
        renders: folder of renders of the edited scene.
        edited: folder of the edited pictures that the scene was fitted to, named as the renders.
        originals: folder of pictures of the scene before the edit, named as the renders.
        source_edit: the edited picture that the others follow.
        prompt: description of the edited scene.
        source_prompt: description of the scene before.
        masks: folder of masks, named as the renders: white counts for Edit PSNR and the perceptual
            distance, black and transparent do not.
        poses, ply: cameras with pictures, and splats of the scene before the edit, for
            :func:`attnwarp_eval.user_images.consistency.measure_consistency`.
        depth: folder of depth maps, for it.
        background: sRGB in [0, 1] behind transparent pixels of pictures.
    """

    renders: Path | None = None
    edited: Path | None = None
    originals: Path | None = None
    source_edit: Path | None = None
    prompt: str | None = None
    source_prompt: str | None = None
    masks: Path | None = None
    poses: Path | None = None
    ply: Path | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    colmap: bool = False
    depth: Path | None = None


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes:
        key: name of the figure in :data:`attnwarp_eval.metrics.registry.METRICS`.
        title: title of the figure in tables.
        value: value over all views; NaN if undefined in all.
        views: view -> value; NaN where undefined, +inf for the PSNR of two equal pictures.
        encoder: kind of the encoder behind it, if any.
    """

    key: str
    title: str
    value: float
    views: Mapping[str, float]
    encoder: Kind | None = None

    @property
    def undefined(self) -> list[str]:
        """Views without a value."""
        return [name for name, value in self.views.items() if np.isnan(value)]

    @property
    def identical(self) -> list[str]:
        """Views whose value is infinite: two equal pictures."""
        return [name for name, value in self.views.items() if np.isinf(value)]


@dataclass
class Measured:
    """The figures of a user's pictures, and reasons for missing ones.

    Attributes:
        missing: title of a missing figure -> reason.
        encoders: kind -> description of the encoder.
        unpaired: sentence for each group of pictures without partners.
        notes: remarks on the values.
    """

    inputs: Inputs
    rows: list[Row] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    encoders: dict[Kind, EncoderInfo] = field(default_factory=dict)
    unpaired: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def any_value(self) -> bool:
        """True if any figure has a value."""
        return any(not np.isnan(row.value) for row in self.rows)


@dataclass(frozen=True)
class Figure:
    """Definition of a figure of pictures, as of :class:`Row`, with the :class:`Inputs` it needs."""

    key: str
    title: str
    needs: tuple[str, ...]
    encoder: Kind | None = None


_EDIT, _CLIP, _DIRECTION, _NEIGHBOURS, _DINO, _CLIP_IMAGE, _PERCEPTUAL = _OF_PAPER = (
    Figure("edit.psnr_mean", "Edit PSNR", ("renders", "edited")),
    Figure("embedding.clip_similarity", "CLIP similarity", ("renders", "prompt"), "clip"),
    Figure(
        "embedding.clip_directional",
        "CLIP directional similarity",
        ("renders", "originals", "prompt", "source_prompt"),
        "clip",
    ),
    Figure(
        "embedding.direction_consistency",
        "CLIP direction consistency",
        ("renders", "originals"),
        "clip",
    ),
    Figure(
        "embedding.dino_image", "DINO single-image similarity", ("renders", "source_edit"), "dino"
    ),
    Figure(
        "embedding.clip_image", "CLIP single-image similarity", ("renders", "source_edit"), "clip"
    ),
    Figure("perceptual.distance", "Perceptual distance", ("renders", "edited"), "perceptual"),
)


def figures() -> tuple[Figure, ...]:
    """Figures of the paper's table, then the registry's other figures of pictures."""
    own = (m for m in METRICS.values() if m.pictures)
    return (*_OF_PAPER, *(Figure(m.name, m.column or m.name, m.pictures) for m in own))


_MASKED = (_EDIT, _PERCEPTUAL)
"""Figures affected by masks; the others use whole pictures."""

PROTOCOL = 5
"""Version; raised when the same pictures would give other figures."""


def measure(
    inputs: Inputs,
    encoders: Mapping[Kind, str | None],
    store: Store,
    *,
    device: str = "cpu",
    load: Callable[..., Any] | None = None,
    report: Reporter = SILENT,
) -> Measured:
    """Compute every figure of the paper's table that the pictures and prompts allow.

    Args:
        encoders: kind -> name, see :func:`attnwarp_eval.encoders.load_encoder`; "none" leaves its
            figures out. A missing kind, or None, takes the bundled one, and its figures are left
            out if there is none.
        store: cache of finished batches, so that an interrupted call is resumed. Views are
            identified by the content of their files.
        device: "cpu" or "cuda", for real encoders.
        load: function that loads an encoder, in place of
            :func:`attnwarp_eval.encoders.load_encoder`.

    Raises:
        InputError: nothing can be computed (the message gives the reason for each figure), a
            picture that cannot be read, a pair of different sizes, two files of one name.
    """
    done = Measured(inputs)
    for name in ("prompt", "source_prompt"):
        text = getattr(inputs, name)
        if text is not None and not text.strip():
            raise InputError(
                f"{_option(name)}: is empty, expected a description of what the pictures show"
            )
    folders = {
        name: pictures_in(getattr(inputs, name), _option(name))
        for name in ("renders", "edited", "originals", "masks")
        if getattr(inputs, name) is not None
    }
    for name in folders:
        maps = normal_maps(getattr(inputs, name))
        if maps:
            done.notes.append(
                f"{_option(name)}: {len(maps)} normal maps beside pictures of the same name are no"
                f" views and are left out, {maps[0]} first"
            )
        turned = [path for path in folders[name].values() if _is_turned(path)]
        if turned:
            done.notes.append(
                f"{_option(name)}: {len(turned)} pictures are turned as their EXIF tags ask,"
                f" {turned[0].name} first"
            )

    def obstacle(figure: Figure) -> str:
        if _views(figure, folders):
            return ""
        used = " and ".join(
            f"{_option(name)} ({_some(folders[name])})" for name in _groups(figure, folders)
        )
        return f"no name stands in all of {used}"

    lacking = {
        name: _option(name)
        for figure in figures()
        for name in figure.needs
        if getattr(inputs, name) is None
    }
    wanted, loaded = usable(figures(), lacking, obstacle, encoders, device, done, load)
    if not wanted:
        raise InputError(
            "nothing can be computed: "
            + "; ".join(f"{title}: {why}" for title, why in done.missing.items())
        )
    views = {figure: _views(figure, folders) for figure in wanted}
    _check_sizes(folders, views)
    _compare_names(folders, views, done)
    source = None
    if inputs.source_edit is not None and any("source_edit" in figure.needs for figure in wanted):
        source = read_picture(inputs.source_edit, inputs.background)  # before the long part
    gathered = _Gathered()
    named = dict.fromkeys(name for files in folders.values() for name in files)
    needed = [name for name in named if any(name in names for names in views.values())]
    tasks = _tasks(inputs, folders, views, needed, loaded, device)
    for batch in results(store, tasks, math.ceil(len(needed) / BATCH), report):
        gathered.add(*batch)
    _rows(inputs, source, views, loaded, gathered, done)
    return done


def pictures_in(folder: Path, option: str) -> dict[str, Path]:
    """The picture files of a folder by their names without suffix, in natural order.

    Normal maps written by ``attnwarp render`` next to its pictures are left out; see
    :func:`normal_maps`.

    Raises:
        InputError: no such folder, no picture in it, or two files that differ in their suffix
            alone.
    """
    if not folder.is_dir():
        raise InputError(
            f"{option}: {folder} is no folder; name the folder that holds the pictures"
        )
    pictures: dict[str, Path] = {}
    normals = normal_maps(folder)
    for path in sorted(folder.iterdir(), key=lambda p: natural(p.name)):
        if path.suffix.lower() not in SUFFIXES or path.name.startswith(".") or not path.is_file():
            continue
        if path.name in normals:
            continue
        if path.stem in pictures:
            raise InputError(
                f"{option}: {pictures[path.stem]} and {path.name} have one name; pictures are"
                " paired by their names without the suffix, so remove or rename one"
            )
        pictures[path.stem] = path
    if not pictures:
        raise InputError(
            f"{option}: {folder} holds no picture, expected files ending in {', '.join(SUFFIXES)}"
        )
    return pictures


def normal_maps(folder: Path) -> list[str]:
    """Names of the normal maps of ``attnwarp render --normal``: NAME.normal.png by NAME.png."""
    maps = folder.glob("*.normal.png")
    return sorted(p.name for p in maps if (folder / f"{p.name[:-11]}.png").is_file())


def read_picture(
    path: Path, background: Sequence[float] = (0.0, 0.0, 0.0), *, beside: Path | None = None
) -> Picture:
    """(H, W, 3) float32 sRGB in [0, 1].

    8 and 16 bits are divided by their largest value; grey becomes three equal channels; transparent
    pixels are laid over ``background``. A picture is rotated by its EXIF tag, as in viewers.

    Args:
        background: sRGB in [0, 1].
        beside: picture of the corresponding pose, which may be the same picture; see
            :func:`attnwarp.io.read_upright`.

    Raises:
        InputError: not a picture, one that is damaged, or one of other than 8 or 16 bits.
    """
    from attnwarp.io import read_upright

    if not path.is_file():
        raise InputError(f"{path}: there is no such file; check the path")
    image = read_upright(path, beside=beside)
    values = image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
    if image.shape[2] == 3:
        return values
    alpha = values[..., 3:]
    return np.clip(values[..., :3] * alpha + (1 - alpha) * np.asarray(background, np.float32), 0, 1)


def inside(picture: Picture) -> npt.NDArray[np.bool_]:
    """(H, W) bool of a mask's picture: where the mean of the channels is above a half."""
    return np.asarray(picture.mean(axis=2) > 0.5)


def usable(
    figures: Iterable[Figure],
    lacking: Mapping[str, str],
    obstacle: Callable[[Figure], str],
    encoders: Mapping[Kind, str | None],
    device: str,
    done: Measured,
    load: Callable[..., Any] | None = None,
) -> tuple[list[Figure], dict[Kind, Any]]:
    """The figures that the inputs allow, and their encoders; ``done`` gets reasons for missing
    ones.

    Args:
        lacking: missing need of a figure -> its option.
        obstacle: reason why a figure with all its needs is missing; empty for none.
        encoders, device, load: as for :func:`measure`.

    Raises:
        InputError: a named encoder cannot be loaded, or is of another kind; an unknown device.
    """
    # Check even if only bundled encoders are needed, which would ignore it.
    device_of(device)
    wanted = []
    for figure in figures:
        if absent := [lacking[need] for need in figure.needs if need in lacking]:
            done.missing[figure.title] = f"needs {' and '.join(absent)}"
        elif figure.encoder is not None and encoders.get(figure.encoder) == OFF:
            done.missing[figure.title] = f"left out by --{figure.encoder} {OFF}"
        elif why := obstacle(figure):
            done.missing[figure.title] = why
        else:
            wanted.append(figure)
    for kind, name in encoders.items():
        if name is None or name == "none":
            continue
        try:
            check_kind(name, kind)  # also where no figure needs it
        except InputError as error:
            raise InputError(f"--{kind}: {error}") from None
    loaded: dict[Kind, Any] = {}
    for kind in dict.fromkeys(figure.encoder for figure in wanted if figure.encoder is not None):
        named = encoders.get(kind)
        try:
            loaded[kind] = (load or load_encoder)(named or DEFAULTS[kind], kind, device=device)
        except InputError as error:
            if named is not None:
                raise InputError(f"--{kind}: {error}") from None
            for figure in wanted:
                if figure.encoder == kind:
                    done.missing[figure.title] = f"needs --{kind}: {error}"
            continue
        done.encoders[kind] = loaded[kind].about
        if loaded[kind].about.source == "bundled":
            done.notes.append(
                f"{loaded[kind].about.name} is small and was trained on random rendered scenes: its"
                " figures rank results among themselves and do not compare with published ones."
                f" --{kind} names a real encoder"
            )
    return [f for f in wanted if f.encoder is None or f.encoder in loaded], loaded


def _views(figure: Figure, folders: Mapping[str, Mapping[str, Path]]) -> list[str]:
    first, *others = _groups(figure, folders)
    return [name for name in folders[first] if all(name in folders[other] for other in others)]


def _groups(figure: Figure, folders: Mapping[str, Mapping[str, Path]]) -> list[str]:
    """The folders of a figure's input pictures."""
    used = [name for name in figure.needs if name in folders]
    return [*used, "masks"] if figure in _MASKED and "masks" in folders else used


def _compare_names(
    folders: Mapping[str, Mapping[str, Path]],
    views: Mapping[Figure, Sequence[str]],
    done: Measured,
) -> None:
    """Name the pictures without a partner in the first folder, the renders if there are any."""
    first, *others = folders
    used = {name for figure in views for name in figure.needs} | (
        {"masks"} if any(figure in views for figure in _MASKED) else set()
    )
    for other in (name for name in others if name in used):
        # A scene is usually fitted to some of its views: renders without an edited picture are not
        # an error.
        for relation, names in (
            (
                f"of {_option(first)} without one in {_option(other)}",
                [n for n in folders[first] if n not in folders[other]],
            ),
            (
                f"of {_option(other)} without one in {_option(first)}",
                [n for n in folders[other] if n not in folders[first]],
            ),
        ):
            if names:
                done.unpaired.append(f"{len(names)} {relation}: {_some(names, 8)}")


def _check_sizes(
    folders: Mapping[str, Mapping[str, Path]], views: Mapping[Figure, Sequence[str]]
) -> None:
    """Check before any computation that both pictures of a pair have one size."""
    from attnwarp.io.images import upright_size

    for figure, names in views.items():
        first, *others = _groups(figure, folders)
        for other in others:
            for name in names:
                one, two = folders[first][name], folders[other][name]
                _same_size(one, upright_size(one), two, upright_size(two))


def _same_size(one: Path, a: tuple[int, ...], two: Path, b: tuple[int, ...]) -> None:
    if a != b:
        turned = next((path for path in (two, one) if _is_turned(path)), None)
        hint = "" if turned is None else f" ({turned} is turned as its EXIF tag asks)"
        raise InputError(
            f"{two} is {b[0]} x {b[1]} px, but {one} is {a[0]} x {a[1]}{hint}: a pair must have one"
            f" size; {'resize' if turned is None else 'turn or resize'} one of the two folders"
        )


def _is_turned(path: Path) -> bool:
    from attnwarp.io.images import orientation

    return orientation(path) != 1


@dataclass
class _Gathered:
    """Parts of each view that the figures need, so that its pictures can be freed.

    Attributes:
        values: key of a figure of single views -> view -> value; of Edit PSNR, the MSE.
        rows: "clip", "dino" or "before" (CLIP of the originals) -> view -> embedding.
    """

    values: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(dict))
    rows: dict[str, dict[str, Embedding]] = field(default_factory=lambda: defaultdict(dict))

    def to_json(self) -> Json:
        """JSON, undefined values as null."""
        return {
            "values": {key: without_nan(own) for key, own in self.values.items()},
            "rows": {
                name: {view: row.tolist() for view, row in own.items()}
                for name, own in self.rows.items()
            },
        }

    def add(self, views: Sequence[str], data: Json) -> None:
        """Add some views, in this order, from the JSON of :meth:`to_json`."""
        for key, own in data["values"].items():
            values = with_nan(own)
            self.values[key] |= {view: values[view] for view in views if view in values}
        for name, own in data["rows"].items():
            self.rows[name] |= {v: np.array(own[v], np.float64) for v in views if v in own}


def _tasks(
    inputs: Inputs,
    folders: Mapping[str, Mapping[str, Path]],
    views: Mapping[Figure, Sequence[str]],
    needed: Sequence[str],
    loaded: Mapping[Kind, Any],
    device: str,
) -> Iterator[Task[tuple[Sequence[str], Json]]]:
    """Batches of the views ``needed`` with the inputs of the figures, each picture read once.

    A batch's files are hashed when its task is taken, just before they are read.
    """
    members = {figure: set(views.get(figure, ())) for figure in figures()}

    def read(group: str, names: Iterable[str]) -> dict[str, Picture]:
        # Transparent parts of a mask count as black, whatever the background of pictures.
        background = (0.0, 0.0, 0.0) if group == "masks" else inputs.background
        return {name: read_picture(folders[group][name], background) for name in names}

    def partners(
        group: str, names: Iterable[str], of: Mapping[str, Picture], first: str = "renders"
    ) -> dict[str, Picture]:
        pictures = read(group, names)
        for name, picture in pictures.items():  # again, for formats whose header alone is not known
            sizes = [(array.shape[1], array.shape[0]) for array in (of[name], picture)]
            _same_size(folders[first][name], sizes[0], folders[group][name], sizes[1])
        return pictures

    def encode(kind: Kind, pictures: Mapping[str, Picture], to: dict[str, Embedding]) -> None:
        if kind in loaded and pictures:
            to.update(zip(pictures, loaded[kind].images(list(pictures.values())), strict=True))

    def distance(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> float:
        return float(loaded["perceptual"].distance([a], [b])[0])

    def gather(batch: Sequence[str]) -> _Gathered:
        result = _Gathered()
        renders = read("renders", [n for n in batch if n in folders.get("renders", {})])
        encode("clip", renders, result.rows["clip"])
        encode("dino", renders, result.rows["dino"])
        changed = [name for name in batch if name in members[_DIRECTION] | members[_NEIGHBOURS]]
        encode("clip", partners("originals", changed, renders), result.rows["before"])
        paired = [name for name in batch if name in members[_EDIT] | members[_PERCEPTUAL]]
        masked = paired if "masks" in folders else []
        masks = {
            name: inside(picture) for name, picture in partners("masks", masked, renders).items()
        }
        for name, picture in partners("edited", paired, renders).items():
            if name in members[_EDIT]:
                error = metrics.mse(picture, renders[name], masks.get(name))
                result.values[_EDIT.key][name] = error
            if name in members[_PERCEPTUAL]:
                try:
                    result.values[_PERCEPTUAL.key][name] = metrics.perceptual(
                        picture, renders[name], distance, masks.get(name)
                    )
                except ValueError as error:
                    raise InputError(f"{folders['edited'][name]}: {error}") from None
        for figure, function in own.items():
            names = [name for name in batch if name in members[figure]]
            first, *others = figure.needs
            shown = [renders if first == "renders" else read(first, names)]
            shown += [partners(group, names, shown[0], first) for group in others]
            for name in names:
                value = float(function(*(pictures[name] for pictures in shown)))
                result.values[figure.key][name] = value
        return result

    own = {f: _function(f) for f in members if f not in _OF_PAPER and members[f]}

    def task(batch: Sequence[str]) -> Task[tuple[Sequence[str], Json]]:
        spec = {
            "probe": "user images",
            "protocol": PROTOCOL,
            "files": {
                group: {name: sha256_of(files[name]) for name in batch if name in files}
                for group, files in folders.items()
            },
            "figures": {
                figure.title: [name for name in batch if name in members[figure]]
                for figure in members
            },
            "versions": {figure.key: METRICS[figure.key].version for figure in own},
            "encoders": {kind: loaded[kind].about.to_dict() for kind in sorted(loaded)},
            "background": list(inputs.background),
            "device": device,
        }
        return Task(
            f"{batch[0]} to {batch[-1]}",
            spec,
            lambda tell: {"views": gather(batch).to_json()},
            lambda record: (batch, record["views"]),
        )

    # Encoders take a batch at once and round differently in another one: a batch is the cell.
    for start in range(0, len(needed), BATCH):
        yield task(needed[start : start + BATCH])


def sha256_of(path: Path) -> str:
    """SHA-256 of a file.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def _rows(
    inputs: Inputs,
    source: Picture | None,
    views: Mapping[Figure, Sequence[str]],
    loaded: Mapping[Kind, Any],
    gathered: _Gathered,
    done: Measured,
) -> None:
    """Add the figures in the order of the paper's table."""
    texts = {
        name: _text(loaded["clip"], getattr(inputs, name), _option(name), done)
        for name in ("prompt", "source_prompt")
        if any(figure.encoder == "clip" and name in figure.needs for figure in views)
    }
    rows = gathered.rows
    for figure, names in views.items():
        if figure is _EDIT:
            _edit_rows(gathered.values[figure.key], done)
            continue
        if figure is _PERCEPTUAL or figure not in _OF_PAPER:
            values = gathered.values[figure.key]
            value = of_views(values)
            done.rows.append(Row(figure.key, figure.title, value, values, figure.encoder))
            continue
        if figure is _CLIP:
            similarity = metrics.clip_similarity(_stack(rows["clip"], names), texts["prompt"])
        elif figure is _DIRECTION:
            similarity = metrics.directional_similarity(
                _stack(rows["before"], names), _stack(rows["clip"], names),
                texts["source_prompt"], texts["prompt"],
            )  # fmt: skip
        elif figure is _NEIGHBOURS:
            similarity = metrics.direction_consistency(
                _stack(rows["before"], names), _stack(rows["clip"], names)
            )
            names = [f"{one} to {two}" for one, two in itertools.pairwise(names)]
        else:
            kind: Kind = "dino" if figure is _DINO else "clip"
            assert source is not None  # the figure needs it, see usable
            edit = loaded[kind].images([source])
            similarity = metrics.image_similarity(edit, _stack(rows[kind], names))
        values = dict(zip(names, map(float, similarity.values), strict=True))
        done.rows.append(Row(figure.key, figure.title, similarity.mean, values, figure.encoder))


def of_views(values: Mapping[str, float]) -> float:
    """The mean of the defined values; NaN without one."""
    defined = [value for value in values.values() if not np.isnan(value)]
    return float(np.mean(defined)) if defined else float("nan")


def _function(figure: Figure) -> Callable[..., float]:
    """Function of the registry that computes a figure from a view's pictures."""
    module, _, name = METRICS[figure.key].function.partition(":")
    return cast(Callable[..., float], getattr(import_module(module), name))


def _edit_rows(errors: Mapping[str, float], done: Measured) -> None:
    psnr = metrics.EditPsnr(tuple(errors), tuple(errors.values()))
    values = dict(zip(psnr.views, psnr.psnr, strict=True))
    done.rows.append(
        Row("edit.psnr_mean", "Edit PSNR, mean of the views", psnr.mean_finite, values)
    )
    done.rows.append(Row("edit.psnr_pooled", "Edit PSNR, pooled", psnr.pooled, values))
    if psnr.identical:
        done.notes.append(
            f"{psnr.identical} edited pictures equal their renders: their PSNR is infinite and not"
            " in the mean of the views; in the pooled figure they count as no error"
        )
    if psnr.undefined:
        done.notes.append(
            f"{psnr.undefined} mask{'s' * (psnr.undefined > 1)} with nothing brighter than half of"
            f" white: nothing of {'those views' if psnr.undefined > 1 else 'that view'} counts"
        )


def _text(clip: Any, text: str, option: str, done: Measured) -> Embedding:
    cut = clip.cut(text) if hasattr(clip, "cut") else 0
    if cut:
        done.notes.append(
            f"{option} is longer than the encoder takes: its last {cut} tokens were not read"
        )
    return np.asarray(clip.texts([text])[0])


def _stack(rows: Mapping[str, Embedding], names: Sequence[str]) -> Embedding:
    return np.stack([rows[name] for name in names])


def natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts view2 before view10."""
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in re.split(r"(\d+)", name) if p]


def _some(names: Iterable[str], count: int = 3) -> str:
    listed = list(names)
    return ", ".join(listed[:count]) + (
        f" and {len(listed) - count} more" if len(listed) > count else ""
    )


def _option(name: str) -> str:
    """The command-line option of a field of Inputs."""
    return "--mask" if name == "masks" else "--" + name.replace("_", "-")
