"""Material of a user study: pictures of edited scenes, from the folders of runs."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from attnwarp.errors import InputError, suggest
from attnwarp.io.file import inside
from attnwarp.io.picture import encode_picture
from attnwarp_eval.canonical_json import digest
from attnwarp_eval.report import read_results
from attnwarp_eval.study.probes.editing.result import EditResult
from attnwarp_eval.study.store import Store

BEFORE, AFTER = "before", "render"
"""Contents of an edited scene's pictures: the view before the edit, and the edited splats."""


RESULTS, MOST_VIEWS = "results.json", 8
"""File of a run on captures, and the number of views shown, evenly spread."""

LEAST = 256
"""Least longest side of a displayed picture, in px."""

OF_A_METHOD = (
    "method", "settings", "editor", "geometry", "mask", "fit", "splats", "budget",
)  # fmt: skip
"""Entries of a cell's spec that decide its pictures, without those of the measurement."""


@dataclass
class Item:
    """One scene under one instruction and seed.

    Attributes:
        scene, edit, seed: scene, edit and seed of the cells.
        instruction: in words.
        content: hash of the scene, the inputs of its views, and the instruction.
        before: by view, the file of the view before the edit.
        methods: by method and view, the file of the edited scene.
    """

    scene: str
    edit: str
    seed: int
    instruction: str
    content: tuple[object, ...]
    before: dict[str, Path] = field(default_factory=dict)
    methods: dict[str, dict[str, Path]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Short text, unique within a study."""
        return f"{self.scene} / {self.edit} / seed {self.seed}"

    @property
    def views(self) -> list[str]:
        """Views of every method, ordered by yaw, others by name."""
        return sorted(set(self.before).intersection(*self.methods.values()), key=_along_the_orbit)


def _along_the_orbit(view: str) -> tuple[float, str]:
    """Sort key for names of :func:`attnwarp_eval.scene.scene.view_name`: yawm30, source, yaw7p5."""
    yaw = re.fullmatch(r"yaw(m?\d+(?:p\d+)?)", view)
    return (float(yaw[1].replace("m", "-").replace("p", ".")) if yaw else 0.0, view)


def read_items(runs: Sequence[Path], methods: Sequence[str] | None = None) -> list[Item]:
    """Read the edited scenes of runs with pictures by at least two methods.

    Args:
        runs: folders.
        methods: variants to compare, or the comma-separated parts of such names; all with
            pictures if None.

    Raises:
        InputError: no such item, a picture outside the folder, a method that no run has, or
            contradictory runs.
    """
    items: dict[tuple[str, str, int], Item] = {}
    first: dict[tuple[str, str], tuple[str, Path]] = {}  # item and method -> how, and the run
    for run in runs:
        captured = (run / RESULTS).is_file()
        for key, one, method, how in _captured(run) if captured else _edited(run):
            item = items.setdefault(key, one)
            if item.content != one.content:
                raise InputError(
                    f"{run}: {item.name}: another scene, size, set of views or instruction than in"
                    " the runs before; build a page from runs of one study"
                )
            former, former_run = first.setdefault((item.name, method), (how, run))
            if former != how:
                raise InputError(
                    f"{run}: {item.name}: {method!r} has other settings than in {former_run}; give"
                    " the variant another name in one of the studies"
                )
            item.methods.setdefault(method, one.methods[method])
    available = list(dict.fromkeys(name for item in items.values() for name in item.methods))
    methods = None if methods is None else _joined(methods, available)
    for name in methods or ():
        if name not in available:
            listed = ", ".join(map(repr, available)) or "none"
            raise InputError(
                f"--methods: got {name!r}, expected methods with pictures: {listed}"
                f"{suggest(name, available)}"
            )
    if methods is not None:
        for item in items.values():
            item.methods = {name: own for name, own in item.methods.items() if name in methods}
    usable = [item for item in items.values() if len(item.methods) > 1 and item.views]
    if not usable:
        raise InputError(
            f"{', '.join(map(str, runs))}: no edited scene has pictures of two methods; name"
            " variants and views under 'pictures' in the study, and run it again"
        )
    return usable


def _joined(parts: Sequence[str], available: Sequence[str]) -> list[str]:
    """Names from the parts of a comma-separated option: a name may have commas itself."""
    whole = {",".join(part.strip() for part in name.split(",")): name for name in available}
    result, rest = [], list(parts)
    while rest:
        counts = range(len(rest), 1, -1)
        count = next((n for n in counts if ",".join(rest[:n]) in whole), 1)
        result.append(whole.get(",".join(rest[:count]), rest[0]))
        rest = rest[count:]
    return result


def _edited(run: Path) -> Iterator[tuple[tuple[str, str, int], Item, str, str]]:
    """(scene, edit and seed; the cell as an item; method; the inputs of its pictures) of a run's
    edited scenes.
    """
    for cell in read_results(Store(run)).cells:
        record = cell.record
        if record is None or not isinstance(record.extra, EditResult):
            continue
        edit, spec = record.extra, record.spec
        content = (
            *(str(spec.get(key)) for key in ("scene", "size", "views", "spp")),
            edit.instruction,
        )
        item = Item(cell.scene, edit.name, cell.seed, edit.instruction, content)
        own: dict[str, Path] = {}
        for picture in record.pictures:
            view = picture.view.removeprefix(f"{edit.name}/")
            if picture.content == BEFORE:
                item.before[view] = run / picture.path
            elif picture.content == AFTER:
                own[view] = run / picture.path
        if not own:
            continue
        how = digest({key: spec[key] for key in OF_A_METHOD if key in spec})
        for method in cell.variants:
            # A separate item for each name: the reader keeps the first and adds to it.
            yield (
                (cell.scene, edit.name, cell.seed),
                replace(item, methods={method: own}),
                method,
                how,
            )


def _captured(run: Path) -> Iterator[tuple[tuple[str, str, int], Item, str, str]]:
    """The edits of a run on captures, in the format of :func:`_edited`."""
    try:
        data = json.loads((run / RESULTS).read_text(encoding="utf-8"))
        for cell in data["cells"]:
            if cell["kind"] != "edit":
                continue
            key = (cell["scene"], cell["edit"], cell["seed"])
            capture = data["captures"][cell["scene"]]
            instruction, count = capture["edits"][cell["edit"]], len(capture["views"])
            chosen = [k * count // MOST_VIEWS for k in range(MOST_VIEWS)]
            views = [f"view-{k:04d}" for k in (chosen if count > MOST_VIEWS else range(count))]
            before, after = (
                {view: inside(run, f"{folder}/{view}.png") for view in views}
                for folder in (capture["originals"], f"{cell['folder']}/renders")
            )
            content = (capture["sha256"], instruction)
            for method in cell["variants"]:
                item = Item(*key, instruction, content, before, {method: after})
                yield key, item, method, cell["id"]
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(
            f"{run / RESULTS}: damaged ({error!r}); run attnwarp-eval captures again, finished"
            " edits are kept"
        ) from None


def read_picture(path: Path) -> bytes:
    """A picture as JPEG, enlarged smoothly to a longest side of :data:`LEAST` px if smaller.

    Raises:
        InputError: the file is missing.
    """
    from PIL import Image

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: {error.strerror}; run the study again to recompute its pictures"
        ) from None
    with Image.open(io.BytesIO(data)) as picture:
        scale = LEAST / max(picture.size)
        if scale <= 1 and picture.format == "JPEG":
            return data
        size = [max(1, round(side * max(1.0, scale))) for side in picture.size]
        pixels = picture.convert("RGB").resize((size[0], size[1]), Image.Resampling.LANCZOS)
    return encode_picture(np.asarray(pixels), ".jpg")


TILES = 4
"""Parts of a scrambled picture, along each side."""


def scrambled(data: bytes, seed: int) -> bytes:
    """A picture's file with its parts moved around, as JPEG."""
    from PIL import Image

    with Image.open(io.BytesIO(data)) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    h, w = (side // TILES for side in pixels.shape[:2])
    tiles = pixels[: h * TILES, : w * TILES].reshape(TILES, h, TILES, w, 3).swapaxes(1, 2)
    order = np.random.default_rng(seed).permutation(TILES * TILES)
    moved = tiles.reshape(-1, h, w, 3)[order].reshape(TILES, TILES, h, w, 3).swapaxes(1, 2)
    return encode_picture(moved.reshape(h * TILES, w * TILES, 3), ".jpg", chroma="420")


def of_views(item: Item, files: Mapping[str, Path]) -> list[bytes]:
    """A method's pictures, or those before the edit, in the order of the item's views."""
    return [read_picture(files[view]) for view in item.views]
