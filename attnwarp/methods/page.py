"""The page that shows an edit: one HTML file with its pictures in it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp.io.file import write_atomically
from attnwarp.io.images import encode_png
from attnwarp.io.names import file_stems
from attnwarp.methods.base import VIEWER_PLY, edit_file
from attnwarp.methods.pictures import SOURCE_COLORS, resized, to_bytes
from attnwarp.methods.scene import to_float
from attnwarp.workdir import MANIFEST, Workdir

PAGE = "index.html"

MOST_ROWS = 12
"""Edited views on the page; the folder has the rest."""

MOST_UNEDITED = 4
"""Views on the page that were not edited; the folder has the rest."""

Photographs = Mapping[str, npt.NDArray[Any]]

_STYLE = """
:root { color-scheme: light dark; --line: #8884; --soft: #8881; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 1200px; padding: 1.5rem; }
h1 { font-size: 1.6rem; }
h2 { font-size: 1.2rem; margin-top: 2em; border-top: 1px solid var(--line); }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25em .7em; text-align: right; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; } th { background: var(--soft); }
.row { display: flex; flex-wrap: wrap; gap: .6rem; margin: .3em 0 1em; }
figure { margin: 0; width: min(180px, calc(50% - .3rem)); }
img { width: 100%; border-radius: 4px; image-rendering: auto; }
figcaption { font-size: .82em; opacity: .8; }
"""


def write_page(
    folder: Workdir, cameras: Sequence[Camera], images: Sequence[npt.NDArray[Any]]
) -> Path:
    """Write ``index.html`` of a finished edit from its folder's files.

    Args:
        folder: of the edit.
        cameras: of the views.
        images: (H, W, 3) photograph of each view, sRGB, uint8, uint16 or floating in [0, 1].

    Returns:
        Its path.
    """
    manifest, result = folder.read_json(MANIFEST), folder.read_json("result.json")
    seconds = folder.read_json("times.json")
    source, *chain = manifest["sources"]
    names = file_stems(cameras)
    about = {
        name: folder.record(edit_file(number, name))
        for number, part in enumerate(manifest["rounds"])
        for name in part["views"]
    }
    targets = [name for name in about if name not in manifest["sources"]]
    photographs = dict(zip(names, images, strict=True))
    parts = [
        f"<h1>{escape(manifest['instruction'])}</h1>",
        _summary(folder, manifest, result),
        f"<h2>Source view: {escape(source)}</h2>",
        _row(
            folder,
            *_before(folder, source, photographs),
            ("edit of the source", f"views/{source}.png"),
            ("its attention features, three principal components", f"features/{source}.png"),
            ("edited scene", f"renders/after/{source}.png"),
        ),
        *_chain(folder, source, chain, about, photographs),
        "<h2>Edited views</h2>",
        _left_out(targets, MOST_ROWS),
    ]
    for name in _spread(targets, MOST_ROWS):
        parts += [
            f"<h3>{escape(name)}, stage {about[name]['round']}: {_shares(about[name])}</h3>",
            _target(folder, name, photographs),
        ]
    rest = [name for name in names if name not in {source, *chain, *targets}]
    if rest:
        parts += ["<h2>Views that were not edited</h2>", _left_out(rest, MOST_UNEDITED)]
        for name in _spread(rest, MOST_UNEDITED):
            parts.append(
                _row(
                    folder,
                    (f"{name}, before, render", f"renders/before/{name}.png"),
                    ("edited scene", f"renders/after/{name}.png"),
                )
            )
    parts += ["<h2>Time</h2>", _table(("part", "seconds"), _times(seconds))]
    parts += ["<h2>Settings</h2>", _settings(manifest["settings"])]
    title = escape(f"{manifest['instruction']} - attnwarp edit")
    page = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )
    path = folder.path / PAGE
    # The name of a view may be no UTF-8.
    write_atomically(path, lambda stream: stream.write(page.encode("utf-8", "replace")))
    return path


def _chain(
    folder: Workdir,
    source: str,
    chain: Sequence[str],
    about: dict[str, Any],
    photographs: Photographs,
) -> list[str]:
    """The further sources, each with what it got from those before."""
    if not chain:
        return []
    colors = " ".join(
        f'<span style="background:rgb{SOURCE_COLORS[k % len(SOURCE_COLORS)]};color:#000;'
        f'padding:0 .5em;border-radius:3px">{escape(name)}</span>'
        for k, name in enumerate([source, *chain])
    )
    parts = [
        "<h2>Further sources</h2>",
        f"<p>Edited in this order, each with features of those before. In the masks: {colors}</p>",
    ]
    for name in chain:
        heading = f"<h3>{escape(name)}: {_shares(about[name])}</h3>"
        parts += [heading, _target(folder, name, photographs)]
    return parts


def _shares(about: dict[str, Any]) -> str:
    """Sentence on the part of a view that gets features, and on their sources."""
    if "sources" not in about:
        return f"{about['injected']:.0%} of the pixels get features of the source"
    each = ", ".join(
        f"{share:.0%} {escape(name)}" for name, share in about["sources"].items() if share > 0
    )
    return f"sources of its pixels: {each or 'none'}"


def _before(
    folder: Workdir, name: str, photographs: Photographs
) -> tuple[tuple[str, str | bytes], ...]:
    """A view before its edit: its photograph at the size of its edit, and the splats' render."""
    h, w = folder.read_picture(f"views/{name}.png").shape[:2]
    seen = to_bytes(resized(to_float(photographs[name]), (h, w)))
    return (
        ("before, photograph", encode_png(seen)),
        ("before, render", f"renders/before/{name}.png"),
    )


def _target(folder: Workdir, name: str, photographs: Photographs) -> str:
    edited = f"views/{name}.png"
    return _row(
        folder,
        *_before(folder, name, photographs),
        ("edited view", edited),
        ("mask", f"masks/{name}.png"),
        ("warped features", f"features/{name}.png"),
        ("edited scene", f"renders/after/{name}.png"),
    )


def _summary(folder: Workdir, manifest: dict[str, Any], result: dict[str, Any]) -> str:
    psnr, counters = result["edit_psnr"], result["counters"]
    rows = [
        ("stages", len(manifest["rounds"])),
        ("edited views", counters["views"]),
        *([("sources among them", counters["sources"])] if counters["sources"] > 1 else []),
        ("splats", counters["splats"]),
        ("iterations of tuning", counters["iterations"]),
        ("share of the targets' pixels with features of the source", f"{counters['injected']:.0%}"),
        ("recorded features", f"{counters['feature_bytes'] / 2**20:.1f} MiB"),
        ("Edit PSNR, pooled over the edited views", _decibels(psnr["pooled"])),
        ("Edit PSNR, mean over them", _decibels(psnr["mean"])),
    ]
    text = "<p>The edited scene is <code>edited.ply</code> in this folder"
    if folder.has(VIEWER_PLY):
        text += f"; viewers of 3DGS open <code>{VIEWER_PLY}</code>"
    return f"{text}.</p>" + _table(("", ""), rows)


def _decibels(value: float | None) -> str:
    return "equal pictures" if value is None else f"{value:.2f} dB"


def _times(seconds: dict[str, float]) -> list[tuple[str, str]]:
    rows = [(part, f"{value:.1f}") for part, value in seconds.items()]
    return [*rows, ("all", f"{sum(seconds.values()):.1f}")]


def _settings(settings: dict[str, Any]) -> str:
    flat = {k: v for k, v in settings.items() if k != "warp"}
    flat |= {f"warp.{k}": v for k, v in settings["warp"].items()}
    rows = [(name, "none" if value is None else value) for name, value in flat.items()]
    return f"<details><summary>all</summary>{_table(('setting', 'value'), rows)}</details>"


def _table(head: tuple[str, str], rows: Sequence[tuple[str, Any]]) -> str:
    top = "".join(f"<th>{escape(name)}</th>" for name in head) if any(head) else ""
    body = "".join(
        f"<tr><td>{escape(str(name))}</td><td>{escape(str(value))}</td></tr>"
        for name, value in rows
    )
    return f"<table>{f'<tr>{top}</tr>' if top else ''}{body}</table>"


def _row(folder: Workdir, *pictures: tuple[str, str | bytes]) -> str:
    """Pictures side by side, each the name of a file or a PNG; files that an edit does not have are
    left out.
    """
    figures = "".join(
        f'<figure><img alt="{escape(text)}" src="{_data(folder, picture)}">'
        f"<figcaption>{escape(text)}</figcaption></figure>"
        for text, picture in pictures
        if isinstance(picture, bytes) or folder.has(picture)
    )
    return f'<div class="row">{figures}</div>'


def _data(folder: Workdir, picture: str | bytes) -> str:
    png = picture if isinstance(picture, bytes) else (folder.path / picture).read_bytes()
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _left_out(names: Sequence[str], most: int) -> str:
    """Says that not all views are on the page, where that is so."""
    return f"<p>{most} of {len(names)}; the folder has all.</p>" if len(names) > most else ""


def _spread(names: Sequence[str], most: int) -> list[str]:
    """Choose at most so many names, evenly spread."""
    if len(names) <= most:
        return list(names)
    return [names[k * len(names) // most] for k in range(most)]
