"""Scores of edited pictures of a bench.

The order of methods is that of one number, fixed before any method was scored: ``error``, the mean
CIEDE2000 over all pixels of all views to the right answer that the source's picture is nearest to.
One answer for all views: another right answer in a view is an error there, and so is what leaks
outside the mask. Unedited, tinted, blurred or copied pictures have large errors.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from attnwarp.colors import ciede2000, to_lab
from attnwarp.errors import InputError
from attnwarp.io import read_image, read_ply
from attnwarp.io.text import read_text
from attnwarp.methods.scene import near_of, render_picture
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.bench.suite import Suite, to_bytes, truth_file
from attnwarp_eval.canonical_json import without_nan
from attnwarp_eval.document.model import Report, Section, Table
from attnwarp_eval.document.write import write_files
from attnwarp_eval.files import write_atomic
from attnwarp_eval.metrics.image import edit_drift
from attnwarp_eval.statistics.intervals import interval
from attnwarp_eval.study.record import with_nan
from attnwarp_eval.study.shared.edit_figures import EditFigures
from attnwarp_eval.study.shared.edit_truth import EditTruth
from attnwarp_eval.world import World

PROTOCOL = 1
"""Version; raised when equal pictures would get other scores."""

Image = npt.NDArray[np.float32]

FIGURES = {
    "error": "error, dE00",
    "amount": "change of the source, dE00",
    "done": "edits done",
    "agreement": "disagreement above the floor, dE00",
    "seen": "the source's answer where it sees",
    "outside": "change outside, dE00",
    "drift": "drift, px",
    "render_error": "error of the splats, dE00",
}
"""Figures by key, with their heads; the first orders methods, less is better."""

LITTLE = 3.0
"""dE00 inside the mask below which a source counts as unedited."""

SMOOTH = 0.5
"""Share of the true edit's gradient inside the mask below which pictures count as smoothed."""


@dataclass(frozen=True)
class Score:
    """Score of one edit of one scene.

    Attributes:
        scene, edit: names.
        figures: values of :data:`FIGURES`; NaN if undefined.
        by_view: figures of each target in the names of studies, such as
            ``fidelity.psnr.edit_inside``.
        remarks: faults of the pictures, in words.
    """

    scene: str
    edit: str
    figures: dict[str, float]
    by_view: dict[str, dict[str, float]]
    remarks: list[str]


def score(
    suite: Path, edited: Path, out: Path, report: Reporter = SILENT, *, key: Path | None = None
) -> list[Score]:
    """Score a folder of edited pictures; finished edits are kept in ``out`` and not done again.

    Args:
        suite: folder of the bench, see :func:`attnwarp_eval.bench.suite.export`.
        edited: folder with SCENE/EDIT/VIEW.png.
        out: folder for bench-score.json and its page.
        report: receiver of progress.
        key: folder of a sealed bench's key.

    Raises:
        InputError: the bench is damaged, its key is missing, no edit is there, or a picture has
            another size.
    """
    bench = Suite.read(suite)
    root = bench.open(suite, key)
    told = json.loads(read_text(edited / "method.json")) if _has(edited, "method.json") else {}
    there = [
        (scene, edit["name"])
        for scene in bench.scenes
        for edit in json.loads(read_text(suite / scene / "edits.json"))["edits"]
    ]
    given = [pair for pair in there if (edited / pair[0] / pair[1]).is_dir()]
    if not given:
        raise InputError(f"{edited}: has no folder SCENE/EDIT, such as {'/'.join(there[0])}")
    scores = []
    for number, (scene, edit) in enumerate(given):
        report.step(number, len(given), f"{scene}, {edit}")
        folder = edited / scene / edit
        kept = out / "scores" / f"{scene}-{edit}.json"
        digest = _digest(truth_file(root, scene), bench.spp, folder)
        stored = json.loads(read_text(kept)) if kept.is_file() else {}
        if stored.get("key") != digest:
            made = _score(bench, root, scene, edit, folder)
            stored = {"key": digest, "score": without_nan(asdict(made))}
            write_atomic(kept, json.dumps(stored).encode())
        scores.append(Score(**_read(stored["score"])))
    missing = [f"{scene}/{edit}" for scene, edit in there if (scene, edit) not in given]
    _write(out, told, scores, missing)
    return scores


def _score(bench: Suite, root: Path, scene: str, edit: str, folder: Path) -> Score:
    of, truth = bench.truth(root, scene, edit)
    pictures, remarks = _pictures(bench, folder)
    source = bench.views[0]
    if source not in pictures:
        raise InputError(f"{folder}: has no {source}.png, which decides the answer; add it")
    judged = truth.judge({source: pictures[source]})
    figures = EditFigures(of, truth, source, pictures, judged)
    rows = {view: figures.row(view) for view in pictures if view != source}
    answer = judged.answer or next(iter(truth.answers))
    remarks += _remarks(truth, pictures, source, answer)
    inside = truth.union[source]
    drifts = [edit_drift(truth.originals[view], image) for view, image in pictures.items()]
    values = {
        "error": _error(truth, pictures, answer),
        "amount": _difference(truth.originals[source], pictures[source], inside),
        "done": float(judged.done),
        "agreement": _mean(row["multiview.delta_e_above.edit_inside"] for row in rows.values()),
        "seen": _mean(row["multiview.same_answer.edit_seen"] for row in rows.values()),
        "outside": _mean(
            _difference(truth.originals[view], image, ~truth.union[view])
            for view, image in pictures.items()
        ),
        "drift": float(np.nanmedian(drifts)) if np.isfinite(drifts).any() else math.nan,
        "render_error": math.nan,
    }
    if (folder / "edited.ply").is_file():
        renders = _renders(of, bench, folder / "edited.ply")
        values["render_error"] = _error(truth, renders, answer)
    return Score(scene, edit, values, rows, remarks)


def _renders(of: World, bench: Suite, path: Path) -> dict[str, Image]:
    splats = read_ply(path)
    cameras = {view: of.camera(view) for view in bench.views}
    near = near_of(list(cameras.values()), splats)
    return {v: render_picture(splats, camera, near, "auto") for v, camera in cameras.items()}


def _pictures(bench: Suite, folder: Path) -> tuple[dict[str, Image], list[str]]:
    pictures, missing = {}, []
    for view in bench.views:
        path = folder / f"{view}.png"
        if not path.is_file():
            missing.append(view)
            continue
        stored = read_image(path)
        if stored.shape[:2] != (bench.size, bench.size):
            h, w = stored.shape[:2]
            raise InputError(
                f"{path}: has {w} x {h} px, expected {bench.size} x {bench.size}; resize it"
            )
        largest = np.float32(np.iinfo(stored.dtype).max)
        pictures[view] = stored[..., :3].astype(np.float32) / largest
    remarks = [f"missing: {', '.join(missing)}"] if missing else []
    return pictures, remarks


def _remarks(
    truth: EditTruth, pictures: Mapping[str, Image], source: str, answer: str
) -> list[str]:
    """Describe pictures that no editing method would give."""
    remarks = []
    inside = truth.union[source]
    if _difference(truth.originals[source], pictures[source], inside) < LITTLE:
        remarks.append("the source is unedited")
    others = {view: image for view, image in pictures.items() if view != source}
    copied = [view for view, image in others.items() if np.array_equal(image, pictures[source])]
    if copied:
        remarks.append(f"copies of the source: {', '.join(copied)}")
    for view, image in others.items():
        if view in copied:
            continue
        errors = {
            name: float(np.square(image - original).mean())
            for name, original in truth.originals.items()
        }
        nearest = min(errors, key=errors.__getitem__)
        if nearest != view and errors[nearest] < 0.5 * errors[view]:
            remarks.append(f"{view} looks like {nearest}: are their names swapped?")
    slopes = [
        _slope(image, truth.union[view]) / _slope(truth.answers[answer][view], truth.union[view])
        for view, image in pictures.items()
        if truth.union[view].any()
    ]
    if slopes and float(np.median(slopes)) < SMOOTH:
        remarks.append(f"smooth: {np.median(slopes):.0%} of the true edit's gradient")
    return remarks


def _error(truth: EditTruth, pictures: Mapping[str, Image], answer: str) -> float:
    true = truth.answers[answer]
    return _mean(_difference(true[view], image, None) for view, image in pictures.items())


def _difference(one: Image, two: Image, where: npt.NDArray[np.bool_] | None) -> float:
    a, b = (to_lab(to_bytes(image)) for image in (one, two))
    values = ciede2000(a, b)
    values = values if where is None else values[where]
    return float(values.mean()) if values.size else math.nan


def _slope(image: Image, where: npt.NDArray[np.bool_]) -> float:
    down, right = np.gradient(image.astype(np.float64).mean(axis=2))
    return float(np.hypot(down, right)[where].mean()) + 1e-9


def _mean(values: Any) -> float:
    finite = [value for value in values if not math.isnan(value)]
    return float(np.mean(finite)) if finite else math.nan


def _digest(truth: Path, spp: int, folder: Path) -> str:
    files = sorted(path for path in folder.iterdir() if path.suffix in (".png", ".ply"))
    parts = [str(PROTOCOL), read_text(truth), str(spp)]
    parts += [f"{path.name}:{hashlib.sha256(path.read_bytes()).hexdigest()}" for path in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _read(data: Mapping[str, Any]) -> dict[str, Any]:
    rows = {view: with_nan(row) for view, row in data["by_view"].items()}
    return {**data, "figures": with_nan(data["figures"]), "by_view": rows}


def _has(folder: Path, name: str) -> bool:
    return (folder / name).is_file()


def table(scores: Sequence[Score]) -> Table:
    """The figures by edit: means over scenes with their 95 % interval."""
    edits = list(dict.fromkeys(score.edit for score in scores))
    rows = []
    for edit in edits:
        of_edit = [score for score in scores if score.edit == edit]
        cells = []
        for name in FIGURES:
            value = interval({score.scene: [score.figures[name]] for score in of_edit})
            bound = f" [{value.low:.2f}, {value.high:.2f}]" if value.bounded else ""
            cells.append("" if math.isnan(value.mean) else f"{value.mean:.2f}{bound}")
        rows.append([edit, str(len(of_edit)), *cells])
    return Table(["edit", "scenes", *FIGURES.values()], rows)


def _write(
    out: Path, told: Mapping[str, Any], scores: Sequence[Score], missing: Sequence[str]
) -> None:
    remarks = [f"{s.scene}, {s.edit}: {text}" for s in scores for text in s.remarks]
    remarks += [f"not handed in: {', '.join(missing)}"] if missing else []
    data = {
        "protocol": PROTOCOL,
        "method": dict(told),
        "scores": [without_nan(asdict(score)) for score in scores],
        "missing": list(missing),
    }
    text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_atomic(out / "bench-score.json", text.encode())
    each = Table(
        ["scene", "edit", *FIGURES.values()],
        [
            [s.scene, s.edit, *("" if math.isnan(v) else f"{v:.2f}" for v in s.figures.values())]
            for s in scores
        ],
        folded=True,
    )
    name = str(told.get("name", "the pictures"))
    lead = [
        "Methods are ordered by `error`: the mean CIEDE2000 over all pixels of all views to the"
        " right answer that the source's picture is nearest to. Disagreement is read beside the"
        " change of the source, since unedited pictures agree too."
    ]
    sections = [
        Section("Scores", remarks, [table(scores)]),
        Section("By scene", tables=[each]),
    ]
    write_files(Report(f"Scores of {name}", lead, sections), out, "bench-score")
