"""Controls of a study of edits: detection of wrong features and of another seed by its figures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES
from attnwarp_eval.report.compared import between
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import report_of
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Variant
from attnwarp_eval.study.shared.controls import OTHER_SEED
from attnwarp_eval.study.shared.edits import VariantPart

BLIND: Literal["blind"] = "blind"
"""Replacement of "can't tell" if the study's control failed."""


def is_control(variant: Variant) -> bool:
    """Return True if a variant takes features from the wrong place, or another seed."""
    return isinstance(variant, VariantPart) and variant.control is not None


def controls_of(results: Results, name: str, baseline: str) -> dict[str, str]:
    """Measured controls of a variant, by label.

    A control differs from its variant in ``control`` alone.
    """
    study, own = results.study, probe(name)
    meaning = own.meaning(study, study.variants[baseline])
    return {
        label: str(variant.part(VariantPart).control)
        for label, variant in study.variants.items()
        if is_control(variant)
        and own.meaning(study, variant.model_copy(update={"control": None})) == meaning
        and results.records(name, label)
    }


def seen(results: Results, name: str, metric: str, baseline: str, label: str) -> bool:
    """Return True if a figure separates a control from its variant: worse, or different for a seed.

    Args:
        results, name, baseline: as for :func:`controls_of`.
        metric: a figure for which one direction is better.
        label: label of the control.
    """
    direction = probe(name).metric(metric).direction
    judged = between(results, name, baseline, label, metric).verdict(direction)  # type: ignore[arg-type]
    other_seed = results.study.variants[label].part(VariantPart).control == OTHER_SEED
    return judged in (("better", "worse") if other_seed else ("worse",))


def blind(results: Results, name: str, metric: str, baseline: str) -> bool:
    """Return True if a study has controls of a variant, and a figure separates none from it.

    Features from the wrong place must do worse. Otherwise the figure does not depend on the
    source of features, so "can't tell" about two warps says nothing.

    Args:
        metric: a figure for which one direction is better.
    """
    found = controls_of(results, name, baseline)
    wrong = [label for label, control in found.items() if control != OTHER_SEED]
    return bool(wrong) and not any(seen(results, name, metric, baseline, label) for label in wrong)


def controls(results: Results) -> list[Section]:
    """The section on controls, a table for each baseline with controls; none for fewer than six
    scenes, on which no test can detect a difference.
    """
    if len(results.study.scenes) < FEWEST_SCENES:
        return []
    pairs = {(one.probe, one.baseline): None for one in results.study.ablations}
    tables = [
        table
        for name, baseline in pairs
        if probe(name).edits
        for table in _tables(results, name, baseline)
    ]
    if not tables:
        return []
    text = (
        "A control takes features from the wrong place, so it has to do worse: then a figure has"
        " seen it. A figure that sees none of them is blind to where features come from. The same"
        " variant with another seed must not be seen."
    )
    return [Section("Controls", [text], tables)]


def _tables(results: Results, name: str, baseline: str) -> Iterator[Table]:
    found = controls_of(results, name, baseline)
    if not found:
        return
    metrics = [metric.format(layer=results.layer) for metric in report_of(name).contrasts]
    metrics = [m for m in metrics if probe(name).metric(m).direction in ("higher", "lower")]
    rows = [
        [
            label,
            "not seen" if control == OTHER_SEED else "seen",
            *(
                "seen" if seen(results, name, metric, baseline, label) else "not seen"
                for metric in metrics
            ),
        ]
        for label, control in found.items()
    ]
    if set(found.values()) != {OTHER_SEED}:
        answers = [BLIND if blind(results, name, m, baseline) else "sees" for m in metrics]
        rows.append(["this figure is", "", *answers])
    yield Table(["control", "expected", *metrics], rows, f"Controls of {baseline!r}")
