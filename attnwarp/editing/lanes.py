"""Parts of a batch edited side by side, each in a thread with its own copy of the editor.

Layers of a small network are too short for a thread of every core, which wait for each other.
Views of a batch know nothing of each other, so each core edits its own.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from threading import Event
from typing import TypeVar

import torch

from attnwarp.editing.editor import Editor, Latent
from attnwarp.editing.small import thread_count

T = TypeVar("T")

Step = Callable[[], None]


def editors_for(editor: Editor, views: int) -> list[Editor]:
    """List an editor and copies of it on the same weights, one for each part of a batch.

    There are as many as torch has threads, at most one a view. An editor stays alone on a GPU, with
    a large network, of which each part decodes for itself and takes the memory for it, within
    autocast, which is of one thread, and with a network whose forward was replaced or compiled,
    which a copy would not follow.

    Example:
        >>> from attnwarp.editing.small import load_editor
        >>> editor = load_editor("small-plain")
        >>> first, *copies = editors_for(editor, views=3)
        >>> first is editor, any(one.network is editor.network for one in copies)
        (True, False)
    """
    if (
        not isinstance(editor, Latent)
        or editor.network.device.type != "cpu"
        or thread_count(editor) > 1
        or torch.is_autocast_enabled("cpu")
    ):
        return [editor]
    networks = [part for part in vars(editor).values() if isinstance(part, torch.nn.Module)]
    replaced = {"forward", "_compiled_call_impl"}
    if any(replaced & vars(module).keys() for part in networks for module in part.modules()):
        return [editor]
    shared = {id(x): x for part in networks for x in (*part.parameters(), *part.buffers())}
    copies = min(views, torch.get_num_threads()) - 1
    try:
        return [editor, *(copy.deepcopy(editor, {**shared}) for _ in range(copies))]
    except TypeError:  # a lock, a file: parts of a subclass that cannot be copied
        return [editor]


def parts_for(views: int, lanes: int) -> list[slice]:
    """Split a batch of views into parts of nearly one size.

    Example:
        >>> parts_for(5, 2)
        [slice(0, 3, None), slice(3, 5, None)]
    """
    ends = [-(-views * k // lanes) for k in range(lanes + 1)]
    return [slice(begin, end) for begin, end in pairwise(ends)]


def side_by_side(jobs: Sequence[Callable[[Step], list[T]]], step: Step) -> list[T]:
    """Run jobs in threads that share torch's threads evenly, and join their results in order.

    The first job runs in this thread. If it fails, the others end at their next step.

    Args:
        jobs: functions of a callback of theirs after each step.
        step: callback of the first job.
    """
    if len(jobs) == 1:
        return jobs[0](step)
    threads, stop = torch.get_num_threads(), Event()

    def go_on() -> None:
        if stop.is_set():
            raise InterruptedError("the first part failed")

    torch.set_num_threads(max(1, threads // len(jobs)))
    try:
        with ThreadPoolExecutor(len(jobs) - 1, "attnwarp-edit") as pool:
            try:
                others = [pool.submit(job, go_on) for job in jobs[1:]]
                results = [jobs[0](step), *(other.result() for other in others)]
            except BaseException:
                stop.set()
                raise
    finally:
        torch.set_num_threads(threads)
    return [one for part in results for one in part]
