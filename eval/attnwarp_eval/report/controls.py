"""Blindness of a study: what its positive controls, wrong warps, do not move."""

from __future__ import annotations

from typing import Literal

from attnwarp_eval.statistics.intervals import paired, verdict
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Variant
from attnwarp_eval.study.shared.edits import VariantPart, editor_of

BLIND: Literal["blind"] = "blind"
"""Word that stands for "can't tell" where the study's control failed."""


def is_control(variant: Variant) -> bool:
    """Return True if a variant takes features from the wrong place."""
    return isinstance(variant, VariantPart) and variant.control is not None


def blind(results: Results, name: str, metric: str, baseline: str) -> bool:
    """Return True if a study has controls of a variant, and a figure tells none of them from it.

    Features from the wrong place have to do worse. Where they don't, the figure does not depend on
    where features come from, so "can't tell" about two warps says nothing.

    Args:
        results: of the run.
        name: of the probe.
        metric: a figure for which one direction is better.
        baseline: of the comparison; its controls have its editor.
    """
    study = results.study
    direction = probe(name).metric(metric).direction
    editor = editor_of(study, study.variants[baseline])
    controls = [
        label
        for label, variant in study.variants.items()
        if is_control(variant) and editor_of(study, variant) == editor and label != baseline
        if results.records(name, label)
    ]
    right = results.views(name, baseline, metric)
    return bool(controls) and not any(
        verdict(paired(right, results.views(name, label, metric)), direction) == "worse"  # type: ignore[arg-type]
        for label in controls
    )
