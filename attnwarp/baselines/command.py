"""The work of the command attnwarp baseline: a method on photographs and fitted splats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from attnwarp.baselines import METHODS, Baseline
from attnwarp.baselines.settings import BaselineSettings, Budget
from attnwarp.editing.editor import own_size
from attnwarp.editing.small import check_instruction, load_editor, thread_count
from attnwarp.fit import compile_kernels, load_views
from attnwarp.gaussians import Gaussians
from attnwarp.io import Dataset
from attnwarp.propagate.progress import progress_display
from attnwarp.propagate.scene import images_of


def edit_dataset(
    method: str,
    dataset: Dataset,
    splats: Gaussians,
    editor_name: str,
    instruction: str,
    settings: BaselineSettings,
    out: Path,
    *,
    budget: Budget,
    max_size: int | None,
    device: str,
    threads: int | None,
    say: Callable[[str], None],
) -> Baseline:
    """Run a method on the views of a data set.

    Args:
        method: see :data:`attnwarp.baselines.METHODS`.
        dataset: cameras and pictures.
        splats: the scene before the edit.
        editor_name: see :func:`attnwarp.editing.small.load_editor`.
        instruction: in words.
        settings: of the method. Without a size, the editor's own is taken.
        out: folder of all results.
        budget: limits of the run.
        max_size: larger pictures are averaged down to it.
        device: of the editor.
        threads: of the editor; see :func:`attnwarp.editing.small.thread_count`.
        say: shows a line to the user.

    Raises:
        InputError: no such editor; a folder of another run.
    """
    views = load_views(dataset, max_size=max_size)
    images = images_of(views)
    editor = load_editor(editor_name, device=device)
    check_instruction(editor_name, editor, instruction)
    torch.set_num_threads(thread_count(editor, threads))
    if settings.size is None:
        settings = settings.changed(size=own_size(editor))
    compile_kernels(splats.kind, say)
    with progress_display(title=out.name) as watch:
        return METHODS[method](
            splats,
            views.cameras,
            images,
            editor,
            instruction,
            settings,
            folder=out,
            budget=budget,
            watch=watch,
        )
