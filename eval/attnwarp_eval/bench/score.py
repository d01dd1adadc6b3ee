"""Scores of pictures and warps of a bench; :mod:`attnwarp_eval.bench.result` has their order."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_erosion

from attnwarp.colors import ciede2000, to_lab
from attnwarp.errors import InputError
from attnwarp.io import read_image, read_ply
from attnwarp.io.file import inside
from attnwarp.methods.scene import near_of, render_picture
from attnwarp.reporting import SILENT, Reporter
from attnwarp_eval.bench import warps
from attnwarp_eval.bench.result import (
    ORDER,
    OWN,
    PROTOCOL,
    WARPS,
    Method,
    Result,
    Score,
    heads_of,
    mean,
    table,
)
from attnwarp_eval.bench.suite import Suite, sha256, to_bytes, truth_file
from attnwarp_eval.canonical_json import read_as, without_nan
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.cost import source_hash
from attnwarp_eval.document.model import Grid, Report, Section, Table
from attnwarp_eval.document.write import write_files
from attnwarp_eval.files import write_atomic
from attnwarp_eval.metrics.image import edit_drift
from attnwarp_eval.study.shared.edit_figures import EditFigures
from attnwarp_eval.study.shared.edit_truth import EditTruth, Judgement, answers_of
from attnwarp_eval.truth import appearance
from attnwarp_eval.world import World

Image = npt.NDArray[np.float32]

LITTLE = 3.0
"""dE00 inside the mask below which a source counts as unedited."""

SMOOTH = 0.5
"""Share of a gradient inside the mask, the original's or the true edit's if less, below which
pictures count as smooth: an editor may keep either."""

DISAGREEMENT = "multiview.delta_e_above.edit_inside"

SHOWN_SCENES, SHOWN_VIEWS = 3, 5
"""Numbers of scenes and views of which a page shows an edit's pictures."""

UNEDITED, COPIED, SMOOTHED = "the source is unedited", "copies of the source", "smooth"
"""Beginnings of remarks on pictures that agree without merit."""


@dataclass(frozen=True)
class _Kept:
    """A finished edit's score, and a hash of all that decides it."""

    key: str
    score: Score


def score(suite: Path, edited: Path, out: Path, report: Reporter = SILENT) -> Result:
    """Score a folder of edited pictures or of warps; what is done is kept in ``out``.

    Args:
        suite: folder of the bench, see :func:`attnwarp_eval.bench.suite.export`.
        edited: folder with SCENE/EDIT/VIEW.png, or with SCENE/VIEW.npz.
        out: folder for bench-score.json and its page.
        report: receiver of progress.

    Raises:
        InputError: the bench is damaged, no edit is there, or a file has another size.
    """
    bench = Suite.read(suite)
    told = Method.read(edited / "method.json")
    told = told.model_copy(update={"name": told.name or edited.resolve().name})
    folders = {
        (scene, edit.name): inside(edited, f"{scene}/{edit.name}")
        for scene in bench.scenes
        for edit in bench.edits(suite, scene)
    }
    if warps.handed_in(bench, edited):
        told = told.model_copy(update={"track": WARPS})
        folders = {(scene, WARPS): inside(edited, scene) for scene in bench.scenes}
    given = {pair: folder for pair, folder in folders.items() if folder.is_dir()}
    if not given or (told.track == WARPS) != (next(iter(given))[1] == WARPS):
        example = edited / bench.scenes[0]
        raise InputError(
            f"{edited}: has nothing to score; write {example / 'EDIT' / 'VIEW.png'} or"
            f" {example / 'VIEW.npz'}, as docs/measuring/bench.md says, or make it with"
            f" attnwarp-eval bench run {suite} {edited}"
        )
    scores = []
    for number, ((scene, edit), folder) in enumerate(given.items()):
        report.step(number, len(given), f"{scene}, {edit}")
        kept = out / "scores" / f"{scene}-{edit}.json"
        digest = _digest(truth_file(suite, scene), bench.spp, folder, told.track)
        stored = None
        with suppress(InputError):  # missing or damaged
            stored = read_as(_Kept, kept, "")
        if stored is None or stored.key != digest:
            if told.track == WARPS:
                made = warps.score(bench, suite, scene, folder)
            else:
                made = _score(bench, suite, scene, edit, folder, told.track)
            stored = _Kept(digest, made)
            write_atomic(kept, json.dumps(without_nan(asdict(stored))).encode())
        scores.append(stored.score)
    missing = ["/".join(pair) for pair in folders if pair not in given]
    result = Result(
        protocol=PROTOCOL, bench=bench.identity(), method=told, scores=scores, missing=missing
    )
    edits = dict.fromkeys(edit for _, edit in given if edit != WARPS)
    grids = [_grid(bench, suite, out, edit, given) for edit in edits]
    _write(out, result, grids)
    return result


def _score(bench: Suite, suite: Path, scene: str, edit: str, folder: Path, track: str) -> Score:
    of, truth = bench.truth(suite, scene, edit)
    pictures, remarks = _pictures(bench, folder)
    source = bench.views[0]
    if source not in pictures:
        raise InputError(f"{folder}: has no {source}.png, which decides the answer; add it")
    judged = truth.judge({source: pictures[source]})
    answer = judged.answer or next(iter(truth.answers))

    def rows_of(judged: Judgement) -> dict[str, dict[str, float]]:
        figures = EditFigures(of, truth, source, pictures, judged)
        return {view: figures.row(view) for view in pictures if view != source}

    # An own editor has answers of its own, so that any source has an edit to agree with.
    rows = rows_of(replace(judged, done=True) if track == OWN else judged)
    scenes = of.scene, of.scene.edited(edit, dict(answers_of(of.scene, edit))[answer])
    again = [to_srgb(appearance(x, of.camera(source), spp=bench.spp, seed=1)) for x in scenes]
    faults = _remarks(truth, pictures, source, answer, again)
    drifts = [edit_drift(truth.originals[view], image) for view, image in pictures.items()]
    values = {
        "error": _error(truth, pictures, answer),
        "apart": mean(abs(row[DISAGREEMENT]) for row in rows.values()),
        "amount": _difference(truth.originals[source], pictures[source], truth.union[source]),
        "done": float(judged.done),
        "agreement": mean(row[DISAGREEMENT] for row in rows.values()),
        "seen": mean(row["multiview.same_answer.edit_seen"] for row in rows.values()),
        "outside": mean(
            _difference(truth.originals[view], image, ~truth.union[view])
            for view, image in pictures.items()
        ),
        "drift": float(np.nanmedian(drifts)) if np.isfinite(drifts).any() else math.nan,
        "render_error": math.nan,
    }
    if (folder / "edited.ply").is_file():
        renders = _renders(of, bench, folder / "edited.ply")
        values["render_error"] = _error(truth, renders, answer)
    return Score(scene, edit, values, rows, [*remarks, *faults])


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
    truth: EditTruth,
    pictures: Mapping[str, Image],
    source: str,
    answer: str,
    again: Sequence[Image],
) -> list[str]:
    """Describe pictures whose agreement has no merit, or is in doubt.

    Args:
        truth, pictures, source, answer: those of an edit.
        again: source before and after the edit, rendered by other random numbers.
    """
    remarks = []
    inside = truth.union[source]
    if _difference(truth.originals[source], pictures[source], inside) < LITTLE:
        remarks.append(UNEDITED)
    others = {view: image for view, image in pictures.items() if view != source}
    copied = [view for view, image in others.items() if np.array_equal(image, pictures[source])]
    if copied:
        remarks.append(f"{COPIED}: {', '.join(copied)}")
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
    # Without its border: a silhouette has a gradient, whatever fills it.
    within = {v: binary_erosion(mask, np.ones((3, 3))) for v, mask in truth.union.items()}
    before_after = {v: (truth.originals[v], truth.answers[answer][v]) for v in within}
    # What two renders share is texture; the rest is noise, which no editor has to paint.
    textures = [
        max(0.01, _power(one, other, within[source]) / _power(one, one, within[source]))
        for one, other in zip(before_after[source], again, strict=True)
    ]
    shares = []
    for view, image in pictures.items():
        of = (_power(one, one, within[view]) for one in before_after[view])
        least = min(power * texture for power, texture in zip(of, textures, strict=True))
        if within[view].any():
            shares.append(math.sqrt(_power(image, image, within[view]) / least))
    if shares and (share := float(np.median(shares))) < SMOOTH:
        remarks.append(f"{SMOOTHED}: {share:.0%} of the true gradient, before or after")
    return remarks


def _error(truth: EditTruth, pictures: Mapping[str, Image], answer: str) -> float:
    """Mean over views inside the mask, plus that outside; a missing view counts as unedited.

    Over all pixels alike, unedited pictures of a small thing would have next to no error.
    """
    shown = {**truth.originals, **pictures}
    errors = {
        view: [
            _difference(true, shown[view], where)
            for where in (truth.union[view], ~truth.union[view])
        ]
        for view, true in truth.answers[answer].items()
    }
    return sum(mean(error[k] for error in errors.values()) for k in (0, 1))


def _difference(one: Image, two: Image, where: npt.NDArray[np.bool_]) -> float:
    a, b = (to_lab(to_bytes(image)) for image in (one, two))
    values = ciede2000(a, b)[where]
    return float(values.mean()) if values.size else math.nan


def _power(one: Image, two: Image, where: npt.NDArray[np.bool_]) -> float:
    """Sum of the product of two pictures' gradients."""
    a, b = (np.gradient(image.astype(np.float64).mean(axis=2)) for image in (one, two))
    return float((a[0] * b[0] + a[1] * b[1])[where].sum()) + 1e-9


def _digest(truth: Path, spp: int, folder: Path, track: str) -> str:
    held = (path for path in folder.iterdir() if path.suffix in (".png", ".ply", ".npz"))
    files = sorted(inside(folder, path.name) for path in held)
    parts = [str(PROTOCOL), track, sha256(truth), str(spp), source_hash()]
    parts += [f"{path.name}:{sha256(path)}" for path in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _grid(
    bench: Suite, suite: Path, out: Path, edit: str, given: Mapping[tuple[str, str], Path]
) -> Grid:
    """Views of an edit's first scenes, before it and as handed in; the files are copied."""
    views = bench.views[:: math.ceil(len(bench.views) / SHOWN_VIEWS)]
    rows = []
    for scene in [scene for scene, name in given if name == edit][:SHOWN_SCENES]:
        sources = {"before": suite / scene / "images", "handed in": given[scene, edit]}
        for row, folder in sources.items():
            paths = []
            for view in views:
                file, path = folder / f"{view}.png", f"pictures/{scene}-{edit}-{row[:6]}-{view}.png"
                if file.is_file():
                    write_atomic(out / path, file.read_bytes())
                paths.append(path if file.is_file() else None)
            rows.append((f"{scene}, {row}", paths))
    return Grid.of(edit, views, rows)


def _write(out: Path, result: Result, grids: list[Grid]) -> None:
    result.write(out / "bench-score.json")
    scores = result.scores
    heads, digits = heads_of(scores[0].edit), 3 if result.method.track == WARPS else 2
    rows = [
        [
            s.scene,
            s.edit,
            *("" if math.isnan(s.figures[k]) else f"{s.figures[k]:.{digits}f}" for k in heads),
        ]
        for s in scores
    ]
    each = Table(["scene", "edit", *heads.values()], rows, folded=True)
    told = result.method
    lead = [
        f"Track: {told.track}, ordered by `{heads[ORDER[told.track]]}`, less is better."
        " Disagreement, errors and shares of what is kept are read beside how much was changed or"
        " kept, since nothing at all has none."
    ]
    tables = [table(scores), *([warps.by_yaw(scores)] if told.track == WARPS else [])]
    sections = [Section("Scores", result.remarks, tables), Section("By scene", tables=[each])]
    sections += [Section("Pictures", grids=grids)] if grids else []
    write_files(Report(f"Scores of {told.name}", lead, sections), out, "bench-score")
