"""Pictures of views, a row for each variant."""

from __future__ import annotations

from attnwarp_eval.document.model import Gallery, Picture, Section
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import report_of, reports
from attnwarp_eval.study.record import PictureFile
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.pictures import CLASSES, DEPTH_RANGE, EPE_RANGE, ORDER, SHARED


def galleries(results: Results) -> list[Section]:
    """Sections of pictures, none if no cell has any."""
    # Edits that the answer shows are not shown again.
    asked = results.study.answer
    shown = {one.probe for one in (asked.pictures if asked else ()) if probe(one.probe).edits}
    own = {
        p.name: section
        for p in reports()
        if p.name not in shown and (section := p.gallery(results)) is not None
    }
    shared = _shared(results, {*own, *shown})
    return [*own.values(), *shared]


def _shared(results: Results, apart: set[str]) -> list[Section]:
    """The pictures of all probes except those with a separate section."""
    by_view: dict[tuple[str, str], list[tuple[str, PictureFile]]] = {}
    for cell in results.cells:
        if cell.probe in apart:
            continue
        for picture in cell.record.pictures if cell.record else ():
            label = report_of(cell.probe).picture_label or cell.variants[0]
            by_view.setdefault((cell.scene, picture.view), []).append((label, picture))
    if not by_view:
        return []
    rows: list[tuple[str, list[Picture]]] = []
    for (scene, view), labelled in by_view.items():
        shared = [
            next((p for _, p in labelled if p.content == content), None) for content in SHARED
        ]
        rows.append((f"**{scene}, {view}**", [Picture(p.path, p.content) for p in shared if p]))
        by_label: dict[str, dict[str, PictureFile]] = {}
        for label, picture in labelled:
            by_label.setdefault(label, {})[picture.content] = picture
        for label, own in by_label.items():
            others = [content for content in own if content not in (*ORDER, *SHARED)]
            contents = [content for content in (*ORDER, *others) if content in own]
            rows.append((label, [Picture(own[c].path, c.replace("-", " ")) for c in contents]))
    legend = "; ".join(f"`{colour}` {name}" for name, (colour, _) in CLASSES.items())
    text = [
        (
            "Warped: the source's own colours as the warp carries them, squares where the mask"
            f" rejects. Mask against truth: {legend}. Endpoint error: dark {EPE_RANGE[0]:g} px to"
            f" bright {EPE_RANGE[1]:g} px, logarithmic, truly visible pixels only. Depth error:"
            f" blue too near, red too far, full colour at {100 * DEPTH_RANGE:g} %."
        ),
    ]
    return [Section("Pictures", text, gallery=Gallery(rows, picker=True), folded=True)]
