"""Our methods on a bench: the track of one editor.

Any method of :data:`attnwarp_eval.study.shared.editing_methods.EDITING_METHODS`, a plugin's among
them, edits the scenes from their public files with an editor of ours. The declaration that it
leaves names the editor by its files' digest, and the method's settings.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from attnwarp import check
from attnwarp.io import read_dataset, read_image, read_ply, write_ply
from attnwarp.methods.scene import near_of, render_picture
from attnwarp.reporting import SILENT, Part, Reporter
from attnwarp_eval.bench import EDITORS, warps
from attnwarp_eval.bench.result import SAME, Method
from attnwarp_eval.bench.suite import FILE, Edit, Suite, sha256, to_bytes
from attnwarp_eval.files import write_picture
from attnwarp_eval.plugins import load_plugins
from attnwarp_eval.study.shared.controls import SCENE_STEP
from attnwarp_eval.study.shared.edit_figures import full_size
from attnwarp_eval.study.shared.edit_truth import EditTruth
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, Job, with_source_words
from attnwarp_eval.study.shared.edits import files_digest
from attnwarp_eval.study.shared.method_run import own_seconds

WARP = "warp"


def run(
    suite: Path,
    out: Path,
    method: str = "attention_warping",
    editor: str = "small-plain",
    *,
    options: Mapping[str, Any] | None = None,
    seed: int = 0,
    report: Reporter = SILENT,
) -> Method:
    """Edit every scene by a method, or warp it; a folder begun earlier is continued.

    A view that the method leaves out is handed in as a render of the edited splats.

    Args:
        suite: folder of the bench.
        out: folder to hand in.
        method: name of the method; :data:`WARP` hands in warps alone, by no editor.
        editor: bundled editor, a folder in diffusers' format, or a key of
            :data:`attnwarp_eval.bench.EDITORS`.
        options: fields of the method's settings (of a warp's for :data:`WARP`), or ``preset``.
        seed: seed of the first scene's noise.
        report: receiver of progress.

    Raises:
        InputError: the folder has pictures of another method or bench, or the bench is damaged.
        ValueError: an unknown method, a wrong setting, or an editor that the method isn't made for.
    """
    load_plugins()
    if method == WARP:
        return warps.run(suite, out, options or {}, report)
    bench, fields = Suite.read(suite), dict(options or {})
    preset = fields.pop("preset", None)
    of = EDITING_METHODS[check.one_of(method, [*EDITING_METHODS, WARP], "method")]
    settings = of.settings(preset, fields, seed)
    noise = f"{settings['noise']} noise" if settings.get("noise") else ""
    told = Method(
        name=", ".join(filter(None, (method, preset, noise))),
        editor=editor, track=SAME, settings=settings,
        editor_sha256="" if editor in EDITORS else files_digest(editor), seconds=0.0,
        bench=sha256(suite / FILE),
    )  # fmt: skip
    told = told.begun(out)
    for number, scene in enumerate(bench.scenes):
        for edit in bench.edits(suite, scene):
            place = out / scene / edit.name
            if all((place / f"{view}.png").is_file() for view in bench.views):
                continue
            report.step(number, len(bench.scenes), f"{scene}, {edit.name}")
            job_settings = with_source_words(
                {**settings, "seed": seed + SCENE_STEP * number}, edit.source
            )
            truth = None
            if editor in EDITORS or of.needs_truth:
                truth = bench.truth(suite, scene, edit.name)[1]
            part = Part(report, number, len(bench.scenes))
            seconds = _edit(suite / scene, place, edit, method, editor, job_settings, truth, part)
            told = told.model_copy(update={"seconds": (told.seconds or 0) + seconds})
            told.write(out)
    return told


def _edit(
    scene: Path,
    place: Path,
    edit: Edit,
    method: str,
    editor: str,
    settings: dict[str, Any],
    truth: EditTruth | None,
    report: Reporter,
) -> float:
    """Write the splats, if tuned, and the pictures of one edit; return the method's seconds."""
    from attnwarp.editing.small import load_editor

    data = read_dataset(scene / "transforms.json")
    names = [path.stem for path in data.image_paths if path is not None]
    images = {
        name: read_image(path)[..., :3].astype(np.float32) / np.float32(255)
        for name, path in zip(names, data.image_paths, strict=True)
        if path is not None
    }
    if editor in EDITORS:
        assert truth is not None
        module, _, function = EDITORS[editor].partition(":")
        loaded = getattr(import_module(module), function)(images, truth, settings["steps"])
    else:
        loaded = load_editor(editor)
    words = edit.target if loaded.guide == "depth" else edit.instruction
    answers = {} if truth is None else truth.answers
    splats = read_ply(scene / "splats.ply")
    with tempfile.TemporaryDirectory() as folder:
        job = Job(
            splats, data.cameras, list(images.values()), loaded, words, settings, Path(folder),
            None, {a: [views[n] for n in names] for a, views in answers.items()}, report=report,
        )  # fmt: skip
        result = EDITING_METHODS[method].run(job)
    if settings.get("iterations") != 0:
        place.mkdir(parents=True, exist_ok=True)
        write_ply(place / "edited.ply", result.gaussians)
    near = near_of(list(data.cameras), splats)
    for number, (name, original) in enumerate(images.items()):
        if number in result.edited:
            picture = full_size(original, result.edited[number])
        else:
            picture = render_picture(result.gaussians, data.cameras[number], near, "auto")
        write_picture(place / f"{name}.png", to_bytes(picture))
    return own_seconds(result)
