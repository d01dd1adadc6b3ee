"""Keys of a study that decide some cell, and a refusal of those that decide none.

A setting that nothing reads gives the figures of another setting under its own name.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from attnwarp.warp import RULES, WarpSettings
from attnwarp_eval.study.schema import Part, Study, Variant

if TYPE_CHECKING:
    from attnwarp_eval.study.probe import Probe

Path = tuple[str, ...]

Readers = Mapping[str, Mapping[str, Set[str]]]
"""Keys of a variant that are read, by the variant and by the probe that reads them."""

DEPTH_READS = frozenset({"preset", "set.depth", "set.depth_statistic"})
"""Keys of a variant that decide how depth is read off splats."""

MASK_RULES = frozenset(
    f"set.{field}"
    for rule in RULES
    for field in (rule.setting, *rule.limits.values())
    if field and field not in ("in_front", "segment", "depth_spread", "normal_angle")
)
"""Keys of a variant that decide its mask and nothing else."""

_WITHOUT_ANGLE = ("none", "facing")

_ALWAYS = frozenset(
    {
        "name",
        "title",
        "description",
        "scenes",
        "population",
        "variants",
        "probes",
        "ablations",
        "fronts",
        "answer",
        "pictures",
    }
)
"""Keys that every study uses. Tables and pictures are checked by what they name."""


def warp_reads(settings: WarpSettings, truth: bool = False) -> set[str]:
    """Keys ``set.FIELD`` of a variant that decide its warp, and ``preset``.

    Args:
        truth: whether depth is the truth's own, which has no splats and no alpha.
    """
    idle = {"set.segment"}  # scenes have none
    limits = {True: set[str](), False: set[str]()}  # of rules that are on, and of those off
    for rule in RULES:
        limits[rule.on(settings)] |= {f"set.{limit}" for limit in rule.limits.values()}
    # A rule's own setting turns it on; the spread concerns feature grids as well.
    idle |= limits[False] - limits[True] - {f"set.{rule.setting}" for rule in RULES}
    idle -= {"set.depth_spread"}
    if truth:
        idle |= {"set.depth", "set.depth_statistic", "set.undefined_depth"}
        idle |= {"set.gaussian_filter", "set.opaque"}
    elif settings.gaussian_filter not in _WITHOUT_ANGLE:
        idle -= {"set.normal_angle"}
    return {"preset", *(f"set.{field.name}" for field in fields(WarpSettings))} - idle


def unused(
    study: Study, named: Set[str], probes: Iterable[Probe[Any]]
) -> Iterator[tuple[Path, str]]:
    """Keys of a study that decide nothing of it, each with what is wrong and what to do.

    Args:
        study: with the parts of every probe.
        named: keys that its file has.
    """
    known = list(probes)
    measuring = [p for p in known if p.name in study.probes or (p.always and study.scenes)]
    by_variant = {
        name: {p.name: p.reads(study, variant) for p in measuring if name in p.measured(study)}
        for name, variant in study.variants.items()
    }
    yield from _of_variants(study, by_variant)
    unread = list(_of_study(study, named, measuring, by_variant))
    for key in unread:
        readers = [p.name for p in known if key in _keys(p, study) and p not in measuring]
        add = f"add {' or '.join(readers)} to probes, or " if readers else ""
        yield (key,), f"nothing that this study measures reads it; {add}leave it out"
    for place in _overridden(study, measuring, by_variant):
        if place[0] not in unread:
            yield place, "no variant takes it from the study; leave it out"
    yield from _of_pictures(study, measuring)


def _keys(p: Probe[Any], study: Study) -> Set[str]:
    """Keys of a study that a probe reads."""
    return set(type(study).model_fields) if p.study_keys is None else p.study_keys


def _of_variants(study: Study, by_variant: Readers) -> Iterator[tuple[Path, str]]:
    for name, readers in by_variant.items():
        place = ("variants", name)
        if not readers:
            yield place, "no probe measures it; name it under probes, or leave it out"
            continue
        for path, value in _named(study.variants[name]):
            if not _is_read(path, readers.values()):
                yield (
                    (*place, *path),
                    f"got {value!r}, which changes nothing in {', '.join(readers)} with the"
                    " variant's other settings; leave it out",
                )


def _of_study(
    study: Study, named: Set[str], measuring: Sequence[Probe[Any]], by_variant: Readers
) -> Iterator[str]:
    """Keys that no probe reads."""
    own = {
        key.partition(".")[0] for r in by_variant.values() for keys in r.values() for key in keys
    }
    read = own.union(_ALWAYS, *(_keys(p, study) for p in measuring))
    yield from (key for key in type(study).model_fields if key in named - read)
    asked = set().union(*(_keys(p, study) for p in measuring if p.name in study.probes))
    if len(study.seeds) > 1 and "seeds" in read - asked:
        yield "seeds"  # what every run measures takes the first alone


def _overridden(
    study: Study, measuring: Sequence[Probe[Any]], by_variant: Readers
) -> Iterator[Path]:
    """Settings for all variants that none takes: each has its own, or does not read it."""
    shared: dict[Path, str] = {("splats",): "splats"}
    for p in measuring:
        shared |= p.shared
    for place, key in shared.items():
        value: Any = study
        for step in place:
            value = getattr(value, step)
        for path, _ in _named(value):
            if not any(
                _is_read((key, *path), readers.values())
                and not _has(study.variants[name], key, path)
                for name, readers in by_variant.items()
            ):
                yield (*place, *path)


def _has(variant: Variant, key: str, path: Path) -> bool:
    """Return True if a variant has a setting of its own in place of the study's."""
    own = getattr(variant, key)
    return path[0] in own if isinstance(own, Mapping) else own is not None


def _of_pictures(study: Study, measuring: Sequence[Probe[Any]]) -> Iterator[tuple[Path, str]]:
    wanted = study.pictures
    if wanted.variants and not wanted.views:
        yield ("pictures", "variants"), "without views no picture is saved; add pictures.views"
    drawn = {name for p in measuring if p.draws for name in study.probes.get(p.name, ())}
    for name in wanted.variants:
        if name not in drawn:
            drawing = ", ".join(p.name for p in measuring if p.draws and not p.always) or "none"
            yield (
                ("pictures", "variants"),
                f"{name!r} is measured by no probe that saves pictures (in this study: {drawing});"
                " leave it out",
            )


def _named(part: Part | Mapping[str, Any]) -> Iterator[tuple[Path, Any]]:
    """Settings that differ from the default, by its place; each entry of a mapping."""
    if isinstance(part, Mapping):
        yield from (((key,), value) for key, value in part.items())
        return
    for key, field in type(part).model_fields.items():
        value = getattr(part, key)
        if value == field.get_default(call_default_factory=True):
            continue
        if isinstance(value, (Part, Mapping)):
            yield from (((key, *path), inner) for path, inner in _named(value))
        else:
            yield (key,), value


def _is_read(path: Path, readers: Iterable[Set[str]]) -> bool:
    whole = {".".join(path[: k + 1]) for k in range(len(path))}
    return any(whole & keys for keys in readers)
