"""Seal of a run on captures, its verification, and a comparison of two sealed runs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attnwarp.errors import InputError
from attnwarp.io.file import inside
from attnwarp_eval.canonical_json import digest, write_json
from attnwarp_eval.cost import environment
from attnwarp_eval.document.model import Table
from attnwarp_eval.document.numbers import number
from attnwarp_eval.statistics.contrasts import contrast
from attnwarp_eval.statistics.intervals import over_scenes
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.store import Problems, Store, StoreError
from attnwarp_lab.captures.cells import rests_on
from attnwarp_lab.captures.manifest import FIGURES
from attnwarp_lab.captures.report import difference
from attnwarp_lab.userstudy.material import RESULTS

SEAL = "seal.json"
"""File of hashes: of the code and its packages, of the inputs, and of every other file."""

APART = "second - first [95 % interval]"
NOTE = "Paired over scenes, edits and seeds. The interval is over scenes; fewer than six have none."

Key = tuple[str, str, str, int]
"""Row, capture, edit and seed."""

Cells = dict[Key, dict[str, Any]]
"""Figures by their title, of each cell."""


def is_sealed(run: Path) -> bool:
    """Return True for the folder of a run on captures that has ended."""
    return (run / SEAL).is_file()


def write_seal(store: Store) -> Path:
    """Write the hashes of everything in a run's folder, with one hash over all of them."""
    here = environment()
    content = {
        "code": here["source"],
        "versions": here["versions"],
        "inputs": store.read_study("manifest")["inputs"],
        "files": {
            path.relative_to(store.root).as_posix(): _sha256(path)
            for path in sorted(store.root.rglob("*"))
            if path.is_file() and path.name not in (SEAL, ".lock")
        },
    }
    path = store.root / SEAL
    write_json(path, {**content, "sha256": digest(content)})
    return path


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_seal(store: Store) -> dict[str, Any]:
    """Content of a seal.

    Raises:
        StoreError: the seal is damaged.
    """
    path = store.root / SEAL
    try:
        seal: dict[str, Any] = json.loads(path.read_bytes())
        whole = seal.pop("sha256") == digest(seal)
        for name in seal["files"]:
            inside(store.root, name)
    except (InputError, ValueError, LookupError, TypeError, AttributeError):
        whole = False
    if not whole:
        raise StoreError(
            f"{path}: is damaged, so nothing says what the files were; remove it to have the folder"
            " sealed as it is"
        )
    return seal


def _broken(store: Store, seal: Mapping[str, Any]) -> dict[str, str]:
    """Name of each changed sealed file, and the kind of change."""
    return {
        name: "changed since it was sealed" if (store.root / name).is_file() else "is missing"
        for name, sha256 in seal["files"].items()
        if not (store.root / name).is_file() or _sha256(store.root / name) != sha256
    }


def verify(store: Store) -> Problems:
    """Recompute the hashes of a sealed run.

    Raises:
        StoreError: the folder is not a run.
    """
    found = store.verify("manifest")
    try:
        seal = _read_seal(store)
    except StoreError as error:
        found.damaged.append(str(error))
        return found
    if store.read_study("manifest")["inputs"] != seal["inputs"]:
        found.damaged.append(f"{store.root / SEAL}: has other inputs than study.json")
    found.damaged += [f"{store.root / name}: {what}" for name, what in _broken(store, seal).items()]
    return found


def open_seal(store: Store, cells: Sequence[Cell]) -> list[str]:
    """Compare a run with its seal and remove the seal; return the sealed files that are missing
    or changed.

    These files are removed with the records of cells that depend on them, so that the run
    regenerates them. A folder without a seal is unchanged.

    Raises:
        StoreError: the seal is damaged.
    """
    if not is_sealed(store.root):
        return []
    broken = list(_broken(store, _read_seal(store)))
    for name in broken:
        for cell in cells:
            if rests_on(cell, name):
                store.path(cell.id).unlink(missing_ok=True)
        (store.root / name).unlink(missing_ok=True)
    # Last: after an earlier interruption the next run finds the same files.
    (store.root / SEAL).unlink()
    return broken


def side_by_side(one: Path, two: Path) -> tuple[list[str], Table]:
    """Compare the inputs of two runs, and their figures by row.

    Raises:
        InputError: a folder is not such a run, or is damaged.
    """
    (study, first), (other, second) = map(_read, (one, two))
    lines = [
        f"other {name}: {', '.join(sorted(differing))}"
        for name in ("captures", "splats", "masks", "weights")
        if (differing := _differing(study["inputs"][name], other["inputs"][name]))
    ]
    seals = [json.loads((run / SEAL).read_bytes()) for run in (one, two)]
    if seals[0]["code"] != seals[1]["code"]:
        lines.append(f"other code: {seals[0]['code'][:12]} and {seals[1]['code'][:12]}")
    lines += [
        f"other {name}: {a} and {b}"
        for name, a in seals[0]["versions"].items()
        if (b := seals[1]["versions"].get(name)) != a
    ]
    rows = []
    for method in dict.fromkeys(key[0] for key in (*first, *second)):
        keys = [key for key in first if key in second and key[0] == method]
        for head, title in FIGURES.items():
            a, b = _pairs(first, second, keys, title)
            means = [over_scenes(side).mean for side in (a, b)]
            apart = contrast(a, b, "plain")
            rows.append([
                method, head, str(apart.views), str(apart.scenes), *map(number, means),
                difference(apart),
            ])  # fmt: skip
    columns = ["variant", "figure", "cells of both", "scenes", "first", "second", APART]
    return lines, Table(columns, rows, NOTE)


def _pairs(
    first: Cells, second: Cells, keys: Sequence[Key], title: str
) -> tuple[dict[str, dict[str, float]], dict[str, dict[str, float]]]:
    """Scene -> edit and seed -> figure of both, if both have it."""
    a: dict[str, dict[str, float]] = {}
    b: dict[str, dict[str, float]] = {}
    for key in keys:
        one, two = (cells[key].get(title) for cells in (first, second))
        if one is not None and two is not None:
            _, scene, edit, seed = key
            for side, value in ((a, one), (b, two)):
                side.setdefault(scene, {})[f"{edit}/{seed}"] = value
    return a, b


def _read(run: Path) -> tuple[dict[str, Any], Cells]:
    """Content of ``study.json``, and figures by row, capture, edit and seed."""
    if not is_sealed(run):
        raise InputError(f"{run}: has no {SEAL}; name the folder of a finished run on captures")
    bad = verify(Store(run))
    if not bad.ok:
        raise InputError(f"{run}: is damaged; attnwarp-eval verify {run} names what")
    cells = json.loads((run / RESULTS).read_bytes())["cells"]
    figures = {
        (method, cell["scene"], cell["edit"], cell["seed"]): cell["figures"] | cell["authors"]
        for cell in cells
        if cell["kind"] == "edit"
        for method in cell["variants"]
    }
    return Store(run).read_study("manifest"), figures


def _differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    return [name for name in {**a, **b} if a.get(name) != b.get(name)]
