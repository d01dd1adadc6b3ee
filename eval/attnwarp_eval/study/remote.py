"""One cell on a worker that shares no disk with the run's folder."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from attnwarp.errors import InputError
from attnwarp.io.file import inside
from attnwarp_eval.cost import environment, source_hash
from attnwarp_eval.files import write_atomic
from attnwarp_eval.plugins import load_plugins
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.scene.spec import MeshSpec
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Probe
from attnwarp_eval.study.record import Failure, Json
from attnwarp_eval.study.store import Store
from attnwarp_eval.study.work import compute, failure


@dataclass(frozen=True)
class Code:
    """Code that a process runs.

    Attributes:
        source: SHA-256 of the source files of both packages and of the plugins.
        versions: versions of Python (major and minor) and of the packages that results depend on.
        worker: name of the worker in the cluster; empty outside one.
        unseen: needed paths that the worker cannot read.
    """

    source: str
    versions: Mapping[str, str]
    worker: str = ""
    unseen: Sequence[str] = ()

    def difference(self, expected: Code) -> str:
        """Difference from the expected code in words; empty if cells would be the same."""
        names = sorted(self.versions.keys() | expected.versions.keys())
        parts = [
            f"{name} {self.versions.get(name, 'missing')}, expected"
            f" {expected.versions.get(name, 'missing')}"
            for name in names
            if self.versions.get(name) != expected.versions.get(name)
        ]
        if self.source != expected.source:
            parts.append(f"source {self.source[:12]}, expected {expected.source[:12]}")
        if self.unseen:
            parts.append(f"cannot read {', '.join(self.unseen)}, expected under these paths")
        return "; ".join(parts)


def this_code() -> Code:
    """The code of this process."""
    with suppress(InputError):  # a worker that lacks a plugin has other code
        load_plugins()
    versions = dict(environment()["versions"])
    versions["python"] = "{}.{}".format(*sys.version_info[:2])
    return Code(source_hash(), versions)


def code_of_worker(request: int = 0, needs: Sequence[str] = ()) -> Code:
    """Code of the worker that executes this call.

    Args:
        request: number that makes each call distinct.
        needs: paths that the worker must be able to read.
    """
    from distributed import get_worker

    unseen = [path for path in needs if not os.access(path, os.R_OK)]
    return replace(this_code(), worker=str(get_worker().name), unseen=unseen)


@dataclass(frozen=True)
class SceneFiles:
    """A scene's file and its meshes.

    Attributes:
        entry: path of the scene's file in ``files``.
        files: file contents by path, all below one folder.
    """

    entry: str
    files: Mapping[str, bytes]


def files_of_scene(scene: Scene) -> SceneFiles | None:
    """Files that a scene is read from; None for a scene made in code.

    A mesh at an absolute path is not sent: workers must be able to read that path.
    """
    if scene.path is None:
        return None
    entry = _absolute(scene.path)
    paths = [entry]
    for item in scene.spec.objects:
        if (
            isinstance(item.shape, MeshSpec)
            and not Path(item.shape.file).expanduser().is_absolute()
        ):
            paths.append(_absolute(scene.mesh_path(item.shape)))
    base = Path(os.path.commonpath([path.parent for path in paths]))
    files = {path.relative_to(base).as_posix(): path.read_bytes() for path in paths}
    return SceneFiles(entry.relative_to(base).as_posix(), files)


def _absolute(path: Path) -> Path:
    """Remove ``..`` from a path; links stay, so that the files keep their relative places."""
    return Path(os.path.abspath(path))  # noqa: PTH100


@dataclass(frozen=True)
class Parcel:
    """Results of a cell that a worker sends back.

    Attributes:
        record: argument of :meth:`attnwarp_eval.study.store.Store.write`.
        pictures: file contents by path relative to the run's folder.
    """

    record: Json
    pictures: Mapping[str, bytes]


_scenes: dict[str, Path] = {}
"""Scene files received by this worker, by the scene's content."""


def compute_and_send(probe: Probe[Any], cell: Cell, scene: SceneFiles | None) -> Parcel | Failure:
    """Compute one cell on a worker and return its files for the run's folder.

    Fits stay on the worker for later cells.

    Args:
        scene: files of the scene; None if this worker has them or needs none.
    """
    from distributed import get_worker

    try:
        worker = get_worker()
        root = Path(worker.local_directory) / "attnwarp"
        content = str(cell.spec.get("scene"))
        if scene is not None:
            _scenes[content] = _unpack_scene(scene, root / "scenes" / content[:16])
        own = cell
        if content in _scenes:
            own = replace(cell, sources={**cell.sources, "scene": str(_scenes[content])})
        record = compute(probe, own, root, worker.state.nthreads)
        names = [picture.path for picture in record.pictures]
        pictures = {name: (root / name).read_bytes() for name in names}
        shutil.rmtree(root / "pictures" / cell.id[:16], ignore_errors=True)
        return Parcel(record.to_json(), pictures)
    except Exception as error:
        return failure(cell, error)


def _unpack_scene(scene: SceneFiles, folder: Path) -> Path:
    for name, content in scene.files.items():
        write_atomic(folder / name, content)
    return folder / scene.entry


def unpack(parcel: Parcel, store: Store) -> Failure | None:
    """Write a received cell into the run's folder: its pictures first, then its record."""
    for name, content in parcel.pictures.items():
        write_atomic(inside(store.root, name), content)
    # The worker's source is this one's, byte for byte; its installed copy may lack the revision.
    here = environment()
    own = {**parcel.record["environment"], "git": here["git"], "source": here["source"]}
    store.write({**parcel.record, "environment": own})
    return None
