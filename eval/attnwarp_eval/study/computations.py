"""Variants that are one computation, and keys of variants that none of their probes reads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.study.cell import Cell
from attnwarp_eval.study.probe import Probe, probe
from attnwarp_eval.study.schema import Study, StudyError


def alike(cells: Iterable[tuple[str, Sequence[str]]]) -> Iterator[tuple[str, list[str]]]:
    """Probes with the variants that share all of their cells there, and so have equal rows.

    Args:
        cells: the probe and the variants of every cell; those of variants timed in turn are left
            out.

    Example:
        >>> list(alike([("warp", ["a", "b"]), ("depth", ["a", "b"]), ("depth", ["b"])]))
        [('warp', ['a', 'b'])]
    """
    places: dict[tuple[str, str], list[int]] = {}
    for number, (name, labels) in enumerate(cells):
        for label in dict.fromkeys(labels) if not probe(name).times_in_turn else ():
            places.setdefault((name, label), []).append(number)
    groups: dict[tuple[str, tuple[int, ...]], list[str]] = {}
    for (name, label), numbers in places.items():
        groups.setdefault((name, tuple(numbers)), []).append(label)
    return ((name, labels) for (name, _), labels in groups.items() if len(labels) > 1)


def check_keys(study: Study, scenes: Mapping[str, Scene], cells: Sequence[Cell]) -> None:
    """Refuse keys of variants that no probe of theirs reads: their rows would be those without.

    Raises:
        StudyError: such a key, or two variants whose warps differ in what no probe reads.
    """
    for label, variant in study.variants.items():
        names = [name for name, labels in study.probes.items() if label in labels]
        seen = set[str]().union(*(_keys_read(probe(p), study, label, scenes) for p in names))
        for key in sorted(variant.model_fields_set - seen) if names else ():
            standard = type(variant).model_fields[key].get_default(call_default_factory=True)
            if getattr(variant, key) != standard:
                raise StudyError(
                    f"variants.{label}.{key}: no probe that measures {label!r}"
                    f" ({', '.join(names)}) reads it; leave it out, or name the variant under a"
                    " probe that does"
                )
    groups = list(alike((cell.probe, cell.labels) for cell in cells))
    for name, (first, *rest) in groups:
        for other in rest if not probe(name).edits else ():
            both = {first, other}
            of = [p for p, labels in study.probes.items() if both & {*labels}]
            if not all(any(p == q and both <= {*labels} for q, labels in groups) for p in of):
                continue
            ours, theirs = (study.variants[label].settings().to_dict() for label in (first, other))
            if differ := [key for key in ours if ours[key] != theirs[key]]:
                raise StudyError(
                    f"variants.{other}.set: differs from {first!r} in {', '.join(differ)} alone,"
                    f" which no probe that measures it ({', '.join(of)}) reads; leave one out, or"
                    " name both under a probe that does"
                )


def _keys_read(own: Probe[Any], study: Study, label: str, scenes: Mapping[str, Scene]) -> set[str]:
    """Keys of a variant that a probe reads to list the variant's first cell; all without any."""
    read: set[str] = set()
    variant = study.variants[label].model_copy()

    class Watched(type(variant)):  # type: ignore[misc]
        def __getattribute__(self, key: str) -> Any:
            read.add(key)
            return super().__getattribute__(key)

    variant.__class__ = Watched
    watched = study.model_copy(update={"variants": {**study.variants, label: variant}})
    first = next(iter(own.cells(watched, [label], scenes)), None)
    return read if first is not None else variant.model_fields_set
