"""First things that a reader should know: three to six sentences, each with a number and a
picture.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

from attnwarp_eval.document.model import Finding, Picture, Slider
from attnwarp_eval.document.numbers import number
from attnwarp_eval.report.ablations import Row
from attnwarp_eval.report.judging import JudgedClaim
from attnwarp_eval.study.probe import probe, probes
from attnwarp_eval.study.probe_report import reports
from attnwarp_eval.study.record import PictureFile
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Ablation

MOST = 6

CLAIMS = 3
"""Findings that claims give at most; the others come from the tables of variants."""

CONTENTS = {
    "occlusion.": ("mask",),
    "warp.feature": ("warped",),
    "warp.": ("endpoint-error", "warped"),
    "depth.": ("depth-error", "render"),
    "fit.": ("render", "depth-error"),
    "multiview.": ("edited",),
    "fidelity.": ("edited",),
    "embedding.": ("edited",),
}
"""Pictures that show a metric, by the beginning of its name."""

RENDERED = {"render", "render_inside", "after"}
"""Parts of a metric's name that speak of the tuned splats, not of the edited views."""


def findings(
    results: Results,
    problems: list[str],
    judged: Sequence[JudgedClaim],
    compared: Sequence[Sequence[Row]],
    *,
    pictures: bool = True,
) -> list[Finding]:
    """Findings of a run: whether the instrument is calibrated, then claims, then the largest
    effects of the tables.

    Args:
        problems: of the instrument, one line each.
        compared: of :func:`attnwarp_eval.report.ablations.compared_of`.
        pictures: whether each has its picture.
    """
    first = [_calibration(results, problems)] if results.finished(_instrument()) else []
    clearest = _clearest(judged)
    claims = [_claim(results, one) for one in clearest]
    told = [set(one.sides) for one in clearest]
    effects = _effects(results, told, compared)
    others = [finding for own in reports() for finding in own.findings(results)]
    chosen = [*first, *claims, *others, *effects][:MOST]
    return chosen if pictures else [replace(finding, picture=None) for finding in chosen]


def _instrument() -> str:
    """The name of the probe that holds the instrument itself to the truth, which every run has."""
    return next(probe.name for probe in probes() if probe.always)


def _calibration(results: Results, problems: list[str]) -> Finding:
    worst = max(
        (
            value
            for cell, record in results.finished(_instrument())
            for view in record.views
            if math.isfinite(value := view.metrics.get("warp.epe_median", math.nan))
        ),
        default=math.nan,
    )
    return Finding(
        "The instrument is not calibrated: " + "; ".join(problems)
        if problems
        else "The instrument is calibrated: the truth's own depth, warped, lands where it should.",
        f"{number(worst, 2)} px",
        "largest median error of a view, no interval",
        "fails" if problems else "holds",
        _warped_and_true(results),
    )


def _clearest(judged_claims: Sequence[JudgedClaim]) -> list[JudgedClaim]:
    """The claims with a clear outcome, those that are told in general before the others."""
    clear = [j for j in judged_claims if len(j.sides) > 1 and j.here != "mixed"]
    return sorted(clear, key=lambda j: (not j.told, j.contrast.flips.p))[:CLAIMS]


def _claim(results: Results, judged: JudgedClaim) -> Finding:
    first, second = list(judged.sides)
    scenes = f"{judged.contrast.scenes} of {len(results.study.scenes)} scenes"
    seen = {"seen": "seen here", "seen where defined": f"seen here in {scenes}"}
    outcome = seen.get(judged.here, "not seen here")
    if judged.told:
        outcome += f", {judged.in_words} in general"
    return Finding(
        f"{judged.claim.text}: {outcome}.",
        judged.difference,
        f"`{judged.metric}`: {second} against {first}",
        "holds" if judged.here in seen else "fails",
        _pair(results, judged.claim.probe, first, second, judged.metric),
    )


def _effects(
    results: Results, told: list[set[str]], compared: Sequence[Sequence[Row]]
) -> list[Finding]:
    """The clearest difference of each table of variants, then the next ones; pairs of variants of
    which a claim has told are left out.
    """
    tables = [
        _of_table(results, ablation, told, own)
        for ablation, own in zip(results.study.ablations, compared, strict=True)
    ]
    rounds = itertools.zip_longest(*tables)
    return [finding for row in rounds for finding in row if finding is not None]


def _of_table(
    results: Results,
    ablation: Ablation,
    told: list[set[str]],
    compared: Sequence[Row],
) -> list[Finding]:
    """The clearest difference of each variant from the baseline, those with pictures first."""
    own, clearest = probe(ablation.probe), dict[str, tuple[bool, float, Finding]]()
    for row in compared:
        name, metric, p, outcome = row.variant, row.metric, row.p, row.outcome
        if outcome not in ("better", "worse") or {name, ablation.baseline} in told:
            continue
        if name in clearest and clearest[name][1] <= p:
            continue
        finding = Finding(
            f"{ablation.title}: `{name}` is {outcome} than `{ablation.baseline}`"
            f" ({own.metric(metric).description}).",
            row.text,
            f"`{metric}`: {name} against {ablation.baseline}",
            "holds" if outcome == "better" else "fails",
            _pair(results, ablation.probe, ablation.baseline, name, metric),
        )
        clearest[name] = (finding.picture is None, p, finding)
    return [finding for *_, finding in sorted(clearest.values(), key=lambda item: item[:2])]


def _warped_and_true(results: Results) -> Slider | None:
    """The source warped by the truth's own depth over the true target."""
    pictures = _pictures(results, _instrument(), _instrument())
    for (scene, view, seed, content), file in pictures.items():
        target = pictures.get((scene, view, seed, "target"))
        if content == "warped" and target is not None:
            title = f"source warped by true depth, {scene}, {view}"
            return Slider(Picture(file.path, title), Picture(target.path, "target"))
    return None


def _pair(results: Results, name: str, first: str, second: str, metric: str) -> Slider | None:
    """The pictures of the view in which two variants differ most.

    Where the first variant of edits has none: the view before and after the edit of the second.
    """
    contents = next((c for start, c in CONTENTS.items() if metric.startswith(start)), ())
    if "edited" in contents and RENDERED.intersection(metric.split(".")):
        contents = ("render",)
    before, after = (_pictures(results, name, variant) for variant in (first, second))
    left, right = (results.views(name, variant, metric) for variant in (first, second))
    differences = {}
    for key in after:
        scene, view, seed, _ = key
        values = [side.get(scene, {}).get(f"{view}/{seed}", math.nan) for side in (left, right)]
        if math.isfinite(difference := abs(values[1] - values[0])):
            differences[key] = difference
    for content in contents:
        own = sorted(key for key in differences if key[3] == content)
        if both := [key for key in own if key in before]:
            most = max(both, key=differences.__getitem__)
            title = f"{content.replace('-', ' ')}, {most[0]}, {most[1]}"
            return Slider(
                Picture(before[most].path, f"{title}: {first}"), Picture(after[most].path, second)
            )
        if edits := [key for key in own if (*key[:3], "before") in after]:
            most = max(edits, key=differences.__getitem__)
            unedited, title = after[(*most[:3], "before")], f"unedited, {most[0]}, {most[1]}"
            return Slider(
                Picture(unedited.path, title), Picture(after[most].path, f"{content}: {second}")
            )
    return None


def _pictures(
    results: Results, name: str, variant: str
) -> dict[tuple[str, str, int, str], PictureFile]:
    """(scene, view, seed, content) -> the picture of a variant."""
    return {
        (scene, picture.view, seed, picture.content): picture
        for scene, seed, record in results.records(name, variant)
        for picture in record.pictures
    }
