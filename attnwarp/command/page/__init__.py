"""Page that shows an edit by any method: one self-contained HTML file."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.camera import up_of
from attnwarp.command.page.measured import CONTROL, disagreement, edited_alone, spill
from attnwarp.command.page.turntable import (
    degrees_apart,
    focus_of,
    orbit,
    renders,
    write_film,
)
from attnwarp.editing.editor import Editor
from attnwarp.fit import Views
from attnwarp.fit.views import to_float
from attnwarp.gaussians import Gaussians
from attnwarp.io import read_ply, write_splat
from attnwarp.io.file import write_atomically
from attnwarp.io.images import encode_png
from attnwarp.io.names import file_stems
from attnwarp.io.splat import RECORD
from attnwarp.methods.base import VIEWER_PLY, edit_file
from attnwarp.methods.change import say_change, say_drift, say_little
from attnwarp.methods.pictures import Bytes, Image, Mask, resized, to_bytes
from attnwarp.methods.scene import near_of
from attnwarp.reporting import SILENT, Reporter
from attnwarp.workdir import MANIFEST, Workdir

PAGE = "index.html"

MOST_VIEWS = 5
"""Largest number of edited views on the page; the folder has the rest."""

MOST_SPLATS = 100_000
"""Largest number of splats on the page, by covered area; ``edited.ply`` has the rest."""

LONGEST = 512
"""Longest side of a picture on the page, in px."""

EXACT, QUALITY = 128, 85
"""Longest side in px of losslessly stored pictures, and JPEG quality of larger ones, of 100."""

CANVAS = 512
"""Longest side of the viewer's picture, in px."""

RENDERS = ("renders/before", "renders/after")


def show_edit(
    folder: Workdir,
    before: Gaussians,
    views: Views,
    *,
    editor: Editor | None = None,
    turntable: Path | None = None,
    notes: Sequence[str] = (),
    origin: str = "",
    report: Reporter = SILENT,
) -> Path:
    """Write the page of a finished edit, ``index.html``, from its folder's files.

    Args:
        views: photographs and cameras of the views.
        editor: editor of the control, which edits the page's views alone; None for no control.
        turntable: file of the orbit's film, GIF or MP4; None for no film.
        origin: sentence on the origin of the inputs, without its full stop.
    """
    page = _Page(folder, views, before)
    if editor is not None:
        shown = [page.names.index(name) for name in page.shown]
        edited_alone(folder, before, views, page.segments, editor, shown, report)
    turns = [renders(model, page.turn) for model in (before, page.after)]
    if turntable is not None:
        write_film(turntable, *turns)
    parts = [page.head(notes, origin), page.scene(), page.views(), page.agreement(), page.outside()]
    parts += [page.orbit(turns), page.costs()]
    return write_page(folder, page.manifest["instruction"], parts, viewer=_file("viewer.js"))


def write_page(
    folder: Workdir, instruction: str, parts: Sequence[str], *, viewer: str = ""
) -> Path:
    """Write ``index.html`` from parts of HTML.

    Args:
        viewer: script of the splats' viewer, if a part shows splats.
    """
    text = Template(_file("page.html")).substitute(
        title=escape(f"{instruction} - attnwarp"),
        style=_file("page.css"),
        body="\n".join(parts),
        script=viewer + _file("page.js"),
    )
    path = folder.path / PAGE
    # The name of a view may not be valid UTF-8.
    write_atomically(path, lambda stream: stream.write(text.encode("utf-8", "replace")))
    return path


class EarlyPage:
    """Page of an edit in progress, which a finished edit's page replaces."""

    def __init__(self, folder: Workdir, views: Views) -> None:
        self.folder, self.photographs = folder, views
        self._figures: dict[str, str] = {}

    def write(self) -> None:
        """Write the page: each view edited so far, below its photograph."""
        manifest = self.folder.read_json(MANIFEST)
        planned = 0
        files: dict[str, str] = {}
        for number, part in enumerate(manifest["rounds"]):
            planned += len(part["views"])
            made = {name: edit_file(number, name) for name in part["views"]}
            files |= {name: file for name, file in made.items() if self.folder.has(file)}
        numbers = {name: k for k, name in enumerate(file_stems(self.photographs.cameras))}
        for name, file in files.items():
            if file not in self._figures:
                edited = self.folder.read_picture(file)
                photograph = self.photographs.picture(numbers[name])
                before = to_bytes(resized(photograph, (edited.shape[0], edited.shape[1])))
                self._figures[file] = captioned(
                    name, {f"{name}, photograph": before, f"{name}, edited": edited}
                )
        title = f"<h1>{escape(manifest['instruction'])}</h1>"
        said = (
            f"<p>The edit is not finished: {len(files)} views are edited so far, {planned} edits"
            " are planned. Reload this page for more; it shows the edited scene once the edit is"
            " done. A stopped edit goes on by the same command.</p>"
        )
        row = f'<div class="row">{"".join(self._figures[file] for file in files.values())}</div>'
        write_page(self.folder, manifest["instruction"], [title, said, row])


class _Page:
    """Parts of a page, each as HTML."""

    def __init__(self, folder: Workdir, views: Views, before: Gaussians) -> None:
        self.folder, self.photographs, self.before = folder, views, before
        cameras = self.cameras = views.cameras
        self.manifest, self.result = folder.read_json(MANIFEST), folder.read_json("result.json")
        self.names = file_stems(cameras)
        # A run ended by its budget lacks the last planned views.
        self.edited = [name for name in self.names if folder.has(f"views/{name}.png")]
        source = self.manifest.get("source")
        self.source = source if source in self.edited else None
        others = [name for name in self.edited if name != self.source]
        room = min(MOST_VIEWS - (self.source is not None), len(others))
        spread = [others[k * len(others) // room] for k in range(room)]
        self.shown = [*([] if self.source is None else [self.source]), *spread]
        files = [f"segments/{name}.png" for name in self.names]
        self.segments = (
            [folder.read_picture(file)[..., 0] > 127 for file in files]
            if all(map(folder.has, files))
            else None
        )
        self.after = read_ply(folder.path / "edited.ply")
        self.first = self.names.index(self.shown[0]) if self.shown else 0
        self.points = before.world_means()
        self.focus = focus_of(cameras, self.points)
        self.turn = orbit(cameras, self.points, first=self.first)

    def head(self, given: Sequence[str], origin: str) -> str:
        """Write the instruction, a summary of the run, warnings, and the origin of the inputs."""
        method = self.manifest["method"]
        cut = self.result["cut"]
        ended = f", cut short by its {cut.replace('_', ' ')}" if cut else ""
        change = self.result["change"]
        said, little = say_change(change, self.segments is not None), say_little(change)
        moved, warned = say_drift(self.result["drift"])
        notes = dict.fromkeys([little, *given, moved if warned else ""])
        lines = [
            f"<h1>{escape(self.manifest['instruction'])}</h1>",
            f"<p><b>{_prose(said[0].upper() + said[1:])}.</b></p>",
            *(f"<p><b>Warning:</b> {_prose(text)}.</p>" for text in notes if text),
            *([] if warned else [f"<p>{_prose(moved[0].upper() + moved[1:])}.</p>"]),
            f"<p>Edited by the method <code>{escape(method)}</code>: {len(self.edited)} of"
            f" {len(self.names)} views were edited, and the splats were tuned on them{ended}."
            " The edited scene is <code>edited.ply</code> in this folder"
            + (
                f"; viewers of 3DGS open <code>{VIEWER_PLY}</code>"
                if self.folder.has(VIEWER_PLY)
                else ""
            )
            + ".</p>",
            *(f"<p>{_prose(text)}.</p>" for text in (origin,) if text),
        ]
        return "\n".join(lines)

    def scene(self) -> str:
        """Write the slider and the splats, side by side."""
        buttons = "".join(
            f'<button aria-pressed="{str(k == 0).lower()}"'
            f' data-pictures=\'["before-{k}", "after-{k}"]\'>{escape(self._title(name))}</button>'
            for k, name in enumerate(self.shown)
        )
        first = self.names[self.first]
        pair = "".join(
            f'<img alt="{escape(first)}, the scene {when}"'
            f' src="{_data(self.folder.read_picture(f"{part}/{first}.png"))}">'
            for part, when in zip(RENDERS, ("before", "after"), strict=True)
        )
        return (
            '<h2>The scene</h2><div class="pair"><figure>'
            f'<div class="slider">{pair}<input type="range" value="50" aria-label="before, after">'
            "</div><figcaption>Rendered splats: before on the left, edited on the right. Drag the"
            f' line.</figcaption><div class="views">{buttons}</div></figure>'
            f"{self._viewer()}</div>"
        )

    def _viewer(self) -> str:
        with TemporaryDirectory() as place:
            path = Path(place) / "edited.splat"
            # Viewers use float32, whose rounding would move splats far from the origin.
            write_splat(path, self.after, coordinates="relative")
            data = path.read_bytes()
        count = len(data) // RECORD.itemsize
        data = data[: MOST_SPLATS * RECORD.itemsize]
        left_out = (
            f" {MOST_SPLATS:,} of {count:,} splats, those that cover most."
            if count > MOST_SPLATS
            else ""
        )
        camera = self.cameras[self.first]
        scale = CANVAS / max(camera.width, camera.height)
        origin = self.after.origin
        about = {
            "width": round(scale * camera.width), "height": round(scale * camera.height),
            "fx": scale * camera.K[0, 0], "fy": scale * camera.K[1, 1],
            "cx": scale * camera.K[0, 2], "cy": scale * camera.K[1, 2],
            "position": (camera.position - origin).tolist(),
            "rotation": camera.rotation.T.tolist(),
            "focus": (self.focus - origin).tolist(),
            "up": up_of(self.cameras)[0].tolist(),
            "near": near_of(self.cameras, self.after),
        }  # fmt: skip
        return (
            '<figure><canvas id="splats" tabindex="0" aria-label="the edited splats"></canvas>'
            "<figcaption>The edited splats themselves: drag to turn, wheel or pinch to zoom, double"
            f" click to go back. Colours do not depend on the view here.{left_out}</figcaption>"
            f'<script type="application/json" id="splat-scene">{json.dumps(about)}</script>'
            '<script type="text/plain" id="splat-bytes">'
            f"{base64.b64encode(data).decode()}</script></figure>"
        )

    def views(self) -> str:
        """Write rows of pictures, a column for each view."""
        carried = any(self.folder.has(f"masks/{name}.png") for name in self.shown)
        rows: list[tuple[str, str, Callable[[str], Bytes | None]]] = [
            ("Photograph", "photograph", self._photograph),
            ("Edited view", "edited", lambda name: self._read(f"views/{name}.png")),
            (
                "The same view edited alone, with the same noise", "edited alone",
                lambda name: self._read(f"{CONTROL}/{name}.png"),
            ),
            ("Scene before", "scene before", lambda name: self._read(f"{RENDERS[0]}/{name}.png")),
            ("Edited scene", "edited scene", lambda name: self._read(f"{RENDERS[1]}/{name}.png")),
            ("Where features came from: white from the source, black from none",
             "where features came from",
             lambda name: self._read(f"masks/{name}.png")),
        ]  # fmt: skip
        cells = [f'<span class="small">{escape(self._title(name))}</span>' for name in self.shown]
        for title, what, picture in rows:
            pictures = [picture(name) for name in self.shown]
            if all(picture is None for picture in pictures):
                continue
            cells.append(f"<b>{title}</b>")
            for k, (name, data) in enumerate(zip(self.shown, pictures, strict=True)):
                id_ = {"scene before": f"before-{k}", "edited scene": f"after-{k}"}.get(what, "")
                cells.append(_figure(f"{name}, {what}", data, id_))
        count = (
            f"{len(self.shown)} of {len(self.edited)} edited views; the folder has all."
            if len(self.shown) < len(self.edited)
            else ""
        )
        if len(self.shown) > 1 and self.source is not None:
            count += f" Degrees are from {escape(self.source)}, about the scene's middle."
        style = f"grid-template-columns: repeat({max(1, len(self.shown))}, minmax(0, 1fr))"
        shares = self._shares() if carried else ""
        grid = f'<div class="grid" style="{style}">{"".join(cells)}</div>'
        return f"<h2>Views</h2><p>{count}</p>{shares}{grid}"

    def _title(self, name: str) -> str:
        if self.source is None or name == self.source:
            return name if self.source is None else f"{name} (source)"
        source, view = (self.cameras[self.names.index(n)] for n in (self.source, name))
        return f"{name}, {degrees_apart(source, view, self.focus):.0f}°"

    def _shares(self) -> str:
        """Write a sentence on the part of the views that receives features."""
        lines = []
        for name in self.shown:
            about = self._record(name)
            if about is not None and name != self.source:
                lines.append(f"{escape(name)} {about['injected']:.0%}")
        if not lines:
            return ""
        return f"<p>Pixels that take features of the source: {'; '.join(lines)}.</p>"

    def _record(self, name: str) -> dict[str, Any] | None:
        numbers = [k for k, part in enumerate(self.manifest["rounds"]) if name in part["views"]]
        made = [edit_file(number, name) for number in numbers]
        about = [self.folder.record(file) for file in made if self.folder.has(file)]
        return about[-1] if about and "injected" in about[-1] else None

    def agreement(self) -> str:
        """Write the differences between pictures of one surface point."""
        sizes = {n: self.folder.read_picture(f"views/{n}.png").shape[:2] for n in self.shown}
        index = {name: self.names.index(name) for name in self.shown}

        def at_size(name: str, pixels: npt.NDArray[Any]) -> Bytes:
            return to_bytes(resized(to_float(pixels), sizes[name]))

        pictures: dict[str, dict[int, Bytes]] = {
            "photographs": {k: at_size(n, self.photographs.picture(k)) for n, k in index.items()}
        }
        parts = {"edited views": "views", "each edited alone": CONTROL, "edited scene": RENDERS[1]}
        for title, part in parts.items():
            read = {n: f"{part}/{n}.png" for n in self.shown if self.folder.has(f"{part}/{n}.png")}
            pictures[title] = {
                index[n]: at_size(n, self.folder.read_picture(file)) for n, file in read.items()
            }
        cameras = {index[n]: self.cameras[index[n]].resize(w, h) for n, (h, w) in sizes.items()}

        def at_edit(masks: Sequence[npt.NDArray[np.bool_] | None]) -> dict[int, Mask]:
            """Resize the shown views' masks to the sizes of their edits."""
            given = {n: mask for n, k in index.items() if (mask := masks[k]) is not None}
            return {
                index[n]: resized(
                    mask[..., None].repeat(3, 2).astype(np.float32), sizes[n]
                )[..., 0] > 0.5
                for n, mask in given.items()
            }  # fmt: skip

        segments = None if self.segments is None else at_edit(self.segments)
        kept = at_edit(self.photographs.masks)
        values = disagreement(self.before, cameras, pictures, segments, kept)
        if "edited views" not in values:
            return ""
        where = "" if segments is None else " inside the mask"
        rows = [(title, f"{value:.1%}") for title, value in values.items()]
        alone = values.get("each edited alone", math.inf)
        same = (
            "<p>Edited alone, with the same noise, the views agree as well: here the noise and the"
            " editor make them agree, and carried features are not needed.</p>"
        ) * (alone <= values["edited views"])
        return (
            "<h2>Do the views agree?</h2><p>Difference between the pictures of two views where"
            f" they show one point of the surface{where}, in percent of the full range: a mean over"
            f" all pairs of the {len(self.shown)} views above, at correspondences of the rendered"
            " splats. Less is more consistent. Photographs differ too: light, texture and depth"
            f" are not exact.</p>{_table(('pictures', 'difference'), rows)}{same}"
        )

    def outside(self) -> str:
        """Write the share of the change outside the mask."""
        title, masks = "<h2>Does it stay inside?</h2>", self.segments
        if masks is None:
            return f"{title}<p>No mask was given, so everything may change.</p>"
        read = [
            [self.folder.read_picture(f"{part}/{name}.png") for name in self.names]
            for part in RENDERS
        ]
        share, covered = spill(read[0], read[1], masks)
        said = "The scene did not change" if math.isnan(share) else (
            f"{share:.0%} of the edited scene's change lies outside the mask"
        )  # fmt: skip
        shown = "".join(
            captioned(name, {f"mask of {name}": self._lit(name)}) for name in self.shown[:2]
        )
        return (
            f"{title}<p>{said}; the mask covers {covered:.0%} of the pictures. It is lit below:"
            " what it lacks of a thing stays as it was, and what it has of another may change.</p>"
            f'<div class="pair">{shown}</div>'
        )

    def _lit(self, name: str) -> Bytes:
        """Darken the photograph outside the mask."""
        mask = self.folder.read_picture(f"segments/{name}.png") / 255
        return lit(self.photographs.picture(self.names.index(name)), mask)

    def orbit(self, turns: Sequence[Sequence[Bytes]]) -> str:
        """Write both scenes' renders from cameras around them."""
        frames = [[_data(picture, quality=80, exact=0) for picture in turn] for turn in turns]
        sides = "".join(
            f'<figure><img class="turned" alt="the scene {when}" src="{turn[0]}">'
            f"<figcaption>{when}</figcaption></figure>"
            for when, turn in zip(("before", "after"), frames, strict=True)
        )
        return (
            f'<h2>All around</h2><div class="orbit"><div class="pair">{sides}</div>'
            '<div class="controls"><button>Play</button>'
            f'<input type="range" min="0" max="{len(self.turn) - 1}" value="0" aria-label="turn">'
            f'</div><script type="application/json">{json.dumps(frames)}</script></div>'
        )

    def costs(self) -> str:
        """Write counts, seconds and settings, folded."""
        psnr, seconds = self.result["edit_psnr"], self.folder.read_json("times.json")
        counts = [
            (name.replace("_", " "), _short(v)) for name, v in self.result["counters"].items()
        ]
        counts += [(f"Edit PSNR, {k}", "-" if psnr[k] is None else f"{psnr[k]:.2f} dB")
                   for k in ("pooled", "mean")]  # fmt: skip
        times = [*((part, f"{value:.1f}") for part, value in seconds.items())]
        times.append(("all", f"{sum(seconds.values()):.1f}"))
        settings = self.manifest["settings"]
        flat = {k: v for k, v in settings.items() if not isinstance(v, dict)}
        flat |= {f"{k}.{n}": w for k, v in settings.items() if isinstance(v, dict)
                 for n, w in v.items()}  # fmt: skip
        listed = [(name, "none" if value is None else value) for name, value in flat.items()]
        folded = "".join(
            f"<details><summary>{title}</summary>{_table(('', ''), rows)}</details>"
            for title, rows in (("Counts", counts), ("Settings", listed))
        )
        return f"<h2>What it took</h2>{_table(('part', 'seconds'), times)}{folded}"

    def _photograph(self, name: str) -> Bytes:
        """Return a view before its edit, at the size of its edit."""
        h, w = self.folder.read_picture(f"views/{name}.png").shape[:2]
        return to_bytes(resized(self.photographs.picture(self.names.index(name)), (h, w)))

    def _read(self, file: str) -> Bytes | None:
        return self.folder.read_picture(file) if self.folder.has(file) else None


def _prose(text: str) -> str:
    """Write a message for a terminal as HTML: what is in backticks is code."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))


def _file(name: str) -> str:
    return files(__name__).joinpath(name).read_text(encoding="utf-8")


def _shrunk(pixels: Bytes) -> Bytes:
    """Shrink a picture to at most :data:`LONGEST`."""
    longest = max(pixels.shape[:2])
    if longest <= LONGEST:
        return pixels
    h, w = (max(1, round(side * LONGEST / longest)) for side in pixels.shape[:2])
    return to_bytes(resized(to_float(pixels), (h, w)))


def _data(pixels: Bytes, quality: int = QUALITY, exact: int = EXACT) -> str:
    """Encode a picture as a data URL: PNG up to a longest side, JPEG beyond."""
    if max(pixels.shape[:2]) <= exact:
        return f"data:image/png;base64,{base64.b64encode(encode_png(pixels)).decode()}"
    import cv2

    bgr = np.ascontiguousarray(_shrunk(pixels)[..., ::-1])
    data = bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def lit(picture: Image, share: npt.NDArray[Any]) -> Bytes:
    """Darken a picture, (h, w, 3) in [0, 1], outside a mask in [0, 1] that broadcasts to it."""
    return to_bytes(picture * (0.2 + 0.8 * share))


def captioned(caption: str, pictures: Mapping[str, Bytes]) -> str:
    """Write pictures, by what they show, above one caption."""
    images = "".join(
        f'<img alt="{escape(text)}" src="{_data(pixels)}">' for text, pixels in pictures.items()
    )
    return f"<figure>{images}<figcaption>{escape(caption)}</figcaption></figure>"


def _figure(text: str, picture: Bytes | None, id_: str = "") -> str:
    """Write a captioned picture; an empty cell without one."""
    if picture is None:
        return "<span></span>"
    name = f' id="{id_}"' if id_ else ""
    return f'<figure><img{name} alt="{escape(text)}" src="{_data(picture)}"></figure>'


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) and value != int(value) else str(value)


def _table(head: tuple[str, str], rows: Sequence[tuple[str, Any]]) -> str:
    top = "".join(f"<th>{escape(name)}</th>" for name in head) if any(head) else ""
    body = "".join(
        f"<tr><td>{escape(str(name))}</td><td>{escape(str(value))}</td></tr>"
        for name, value in rows
    )
    return f"<table>{f'<tr>{top}</tr>' if top else ''}{body}</table>"
