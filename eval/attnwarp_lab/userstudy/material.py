"""Material of a user study: pictures of edited scenes, from the folders of runs."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from attnwarp.errors import InputError, suggest
from attnwarp.io.file import inside
from attnwarp.io.picture import encode_picture
from attnwarp_eval.report import read_results
from attnwarp_eval.study.probes.editing.result import EditResult
from attnwarp_eval.study.store import Store

BEFORE, AFTER = "before", "render"
"""Contents of an edited scene's pictures: the view before the edit, and the edited splats."""


RESULTS, MOST_VIEWS = "results.json", 8
"""File of a run on captures, and the number of views shown, evenly spread."""

LEAST = 256
"""Least longest side of a displayed picture, in px."""


@dataclass
class Item:
    """One scene under one instruction and seed.

    Attributes:
        scene, edit, seed: scene, edit and seed of the cells.
        instruction: in words.
        before: by view, the file of the view before the edit.
        methods: by method and view, the file of the edited scene.
    """

    scene: str
    edit: str
    seed: int
    instruction: str
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


def read_items(run: Path, methods: Sequence[str] | None = None) -> list[Item]:
    """Read the edited scenes of a run with pictures by at least two methods.

    Args:
        run: folder of a study's run, or of one on captures.
        methods: variants to compare; all with pictures if None.

    Raises:
        InputError: no such item, a picture outside the folder, or a method that the run lacks.
    """
    items: dict[tuple[str, str, int], Item] = {}
    captured = (run / RESULTS).is_file()
    for one in _captured(run) if captured else _edited(run):
        item = items.setdefault((one.scene, one.edit, one.seed), one)
        item.methods.update(one.methods)
    available = list(dict.fromkeys(name for item in items.values() for name in item.methods))
    for name in methods or ():
        if name not in available:
            listed = ", ".join(map(repr, available)) or "none"
            raise InputError(
                f"--method: got {name!r}, expected methods with pictures: {listed}"
                f"{suggest(name, available)}"
            )
    if methods is not None:
        for item in items.values():
            item.methods = {name: own for name, own in item.methods.items() if name in methods}
    usable = [item for item in items.values() if len(item.methods) > 1 and item.views]
    if not usable:
        raise InputError(
            f"{run}: no edited scene has pictures of two methods; name variants and views under"
            " 'pictures' in the study, and run it again"
        )
    return usable


def _edited(run: Path) -> Iterator[Item]:
    """Edited scenes of a study's run, each with the pictures of one cell."""
    for cell in read_results(Store(run)).cells:
        record = cell.record
        if record is None or not isinstance(record.extra, EditResult):
            continue
        edit = record.extra
        item = Item(cell.scene, edit.name, cell.seed, edit.instruction)
        own: dict[str, Path] = {}
        for picture in record.pictures:
            view = picture.view.removeprefix(f"{edit.name}/")
            if picture.content == BEFORE:
                item.before[view] = run / picture.path
            elif picture.content == AFTER:
                own[view] = run / picture.path
        if own:
            item.methods = dict.fromkeys(cell.variants, own)
            yield item


def _captured(run: Path) -> Iterator[Item]:
    """Edited scenes of a run on captures, as those of :func:`_edited`."""
    try:
        data = json.loads((run / RESULTS).read_text(encoding="utf-8"))
        for cell in data["cells"]:
            capture = data["captures"][cell["scene"]]
            instruction, count = capture["edits"][cell["edit"]], len(capture["views"])
            chosen = [k * count // MOST_VIEWS for k in range(MOST_VIEWS)]
            views = [f"view-{k:04d}" for k in (chosen if count > MOST_VIEWS else range(count))]
            before, after = (
                {view: inside(run, f"{folder}/{view}.png") for view in views}
                for folder in (capture["originals"], f"{cell['folder']}/renders")
            )
            methods = dict.fromkeys(cell["variants"], after)
            yield Item(cell["scene"], cell["edit"], cell["seed"], instruction, before, methods)
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
