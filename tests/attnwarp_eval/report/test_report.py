"""Hand-made records with known numbers; the expected tables, verdicts and warnings follow by
hand."""

import dataclasses
import functools
import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
import written_runs
from scipy import stats

from attnwarp.errors import InputError
from attnwarp_eval.document.model import Table
from attnwarp_eval.document.numbers import number, spread
from attnwarp_eval.document.write import inline, markdown
from attnwarp_eval.metrics.occlusion import COUNTS
from attnwarp_eval.report import claims
from attnwarp_eval.report.ablations import compared_of, differences, glossary, in_detail
from attnwarp_eval.report.build import build, problems
from attnwarp_eval.report.claims import Claim, load_claims
from attnwarp_eval.report.compared import between
from attnwarp_eval.report.fronts import fronts
from attnwarp_eval.report.judging import (
    Comparison,
    claim_row,
    claims_section,
    judge,
    judged,
    measured,
    outcome,
)
from attnwarp_eval.report.measured import regime
from attnwarp_eval.scene.yaml import read_yaml
from attnwarp_eval.statistics.contrasts import contrast
from attnwarp_eval.statistics.intervals import interval
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.probe_report import Layout, report_of
from attnwarp_eval.study.probes.editing.report import abilities, published, source_edits
from attnwarp_eval.study.probes.editing.result import EditResult
from attnwarp_eval.study.shared.edit_truth import EditTruth, Judgement
from attnwarp_eval.study.study import load_study, parse_variant

ROOT = Path(__file__).parents[3]
SCENES = ("one", "two", "three")
SLIP = "warp.epe_median_layer.64"


def tabulated(run):
    return in_detail(run, compared_of(run, judge(run, load_claims())))


def study(**changes):
    return {
        "name": "hand-made",
        "scenes": list(SCENES),
        "variants": {"good": {}, "slipped": {"set": {"pixel_centers": "integer"}}},
        "probes": {"warp": ["good", "slipped"]},
        "ablations": [
            {"title": "Slip", "probe": "warp", "baseline": "good", "variants": ["slipped"]}
        ],
        **changes,
    }


def record(values, environment=written_runs.ENVIRONMENT):
    """A warp cell whose views show ``values`` of the slip's metric (None: undefined)."""
    counts = {f"occlusion.{name}": 0 for name in COUNTS}
    return written_runs.record(
        [(f"v{i}", 30.0 * i, {SLIP: value, **counts}) for i, value in enumerate(values)],
        cost={"seconds": {"steady": 0.1}, "counters": {"pairs": 2_000_000}},
        environment=environment,
    )


def results(table, more=(), **changes):
    """``table``: variant -> one list of view values a scene, or None where the cell was not
    measured.
    """
    cells = [
        written_runs.outcome(
            "warp",
            scene,
            [variant],
            None if values is None else record(values),
            f"{variant}-{scene}",
        )
        for variant, rows in table.items()
        for scene, values in zip(SCENES, rows, strict=True)
    ]
    return written_runs.results(study(**changes), [*cells, *more])


def cell(variant, scene, views, *, seed=0, seconds=None):
    """A warp cell of views (name, yaw, figures)."""
    cost = {"seconds": seconds or {"steady": 0.1}, "counters": {}}
    data = written_runs.record(views, cost=cost)
    return written_runs.outcome(
        "warp", scene, [variant], data, f"{variant}-{scene}-{seed}", seed=seed
    )


# Differences of 0.50, 0.49 and 0.51 px: an interval of 4.303 * 0.01 / sqrt(3) to either side.
CLEAR = {"good": [[0.1, 0.1]] * 3, "slipped": [[0.6, 0.6], [0.48, 0.7], [0.7, 0.52]]}

SLIP_CLAIM = Claim(
    "slip",
    "It slips",
    "warp",
    "warp.epe_median_layer.{layer}",
    {},
    "higher",
    {"set": {"pixel_centers": "integer"}},
    study="hand-made",
)

DRAWN = tuple(f"drawn-{k}" for k in range(8))


def drawn(table, seeds=(0,), **changes):
    """A run on eight scenes that were drawn: variant -> for each seed one figure a scene."""
    cells = [
        cell(variant, scene, [("v0", 0.0, {SLIP: value})], seed=seed)
        for variant, rows in table.items()
        for seed, row in zip(seeds, rows, strict=True)
        for scene, value in zip(DRAWN, row, strict=True)
    ]
    content = study(scenes={"drawn": len(DRAWN), "seed": 7}, seeds=list(seeds), **changes)
    return written_runs.results(content, cells)


CLEARLY = {"good": [[0.1] * 8], "slipped": [[0.5, 0.6, 0.7, 0.6, 0.5, 0.8, 0.9, 0.6]]}

UNSURE = np.exp([0.5, -0.2, 0.6, 0.1, -0.3, 0.4, 0.2, -0.1])
"""Factors between two sides that eight scenes cannot tell from 1."""

HALF_TOLD = {"good": [[0.1] * 8], "slipped": [list(0.1 * UNSURE)]}


def power(scenes, effect, level):
    """SciPy's power of a t test of a difference of so many standard deviations."""
    beyond = stats.t.ppf(0.5 + level / 2, scenes - 1)
    return stats.nct.sf(beyond, scenes - 1, effect * math.sqrt(scenes))


def test_a_mean_says_what_was_undefined_and_which_scenes_are_missing():
    value = interval({"a": [1.0, float("nan")], "b": [3.0]})
    # Two scene means 1 and 3: half width is t(0.975, 1 degree of freedom) * 1 = 12.7.
    assert spread(value, 3) == "2.00 (1.00 to 3.00) (1 undefined, 2 of 3 scenes)"
    assert spread(interval({"a": []})) == "–"


def test_an_ablation_table_shows_means_differences_and_verdicts():
    (section,) = tabulated(results(CLEAR))
    main, _, contrasts = section.tables
    column = main.columns.index("EPE on 64, layer px")
    assert [row[column] for row in main.rows] == ["0.100", "0.600 (0.590 to 0.610)"]
    assert [row[main.columns.index("M splat-pixel pairs a view")] for row in main.rows] == [
        "1.00",
        "1.00",
    ]
    row = next(row for row in contrasts.rows if row[1] == SLIP)
    assert row[0] == "slipped"
    logs = [np.log(np.array(values) / 0.1).mean() for values in CLEAR["slipped"]]
    mean, low, high = (number(math.exp(x)) for x in (np.mean(logs), min(logs), max(logs)))
    assert row[2] == f"× {mean} ({low} to {high})"
    assert row[3] == "3 of 3 scenes higher; no verdict"
    assert row[6] == "3, 6"


@pytest.mark.parametrize(
    ("views", "mean", "pooled"),
    [
        # Equal pictures: a record has no infinite number, and their error says what they are.
        ([(20.0, 0.01), (None, 0.0)], "20.0 (1 undefined)", 0.005),
        ([(20.0, 0.01), (None, None)], "20.0 (1 undefined)", 0.01),
        ([(None, 0.0), (None, 0.0)], "–", 0.0),
    ],
)
def test_a_pooled_psnr_is_that_of_the_views_mean_error(views, mean, pooled):
    names = ("image.psnr.edit_render", "image.mse.edit_render")
    figures = [(f"edit/v{i}", 0.0, dict(zip(names, v, strict=True))) for i, v in enumerate(views)]
    judgement = Judgement("red", True, 20.0, 10.0, 10.0)
    extra = EditResult("red", "paint it red", judgement, judgement, {}, {}, 30.0, 2, 0.0)
    data = written_runs.record(figures, **extra.to_json())
    cell = written_runs.outcome("editing", "one", ["mine"], data)
    content = {
        **study(variants={"mine": {}, "other": {}}, probes={"editing": ["mine", "other"]}),
        "ablations": [
            {"title": "Mine", "baseline": "mine", "variants": ["other"], "probe": "editing"}
        ],
    }
    (section,) = tabulated(written_runs.results({**content, "scenes": ["one"]}, [cell]))
    row = dict(zip(section.tables[0].columns, section.tables[0].rows[0], strict=True))
    assert row["Edit PSNR, dB"] == mean
    shown = float(row["Edit PSNR, pooled"].split()[0])
    assert shown == (math.inf if pooled == 0 else pytest.approx(-10 * math.log10(pooled), rel=5e-3))


def test_a_comparison_that_a_claim_makes_has_its_verdict_in_the_tables_and_no_part_in_their_family(
    slip_declared,
):
    """Oracle: sign patterns counted out, adjusted by hand (Benjamini, Hochberg)."""
    recall, precision = "occlusion.recall", "occlusion.precision"
    # Differences of eight scenes: of one sign, and with one or two of the other. A claim speaks of
    # SLIP alone.
    signs = {SLIP: [1] * 8, recall: [-1] * 7 + [1], precision: [-1] * 6 + [1, 1]}
    cells = [
        cell(
            variant,
            scene,
            [("v0", 0.0, {m: 0.4 * (1 + 0.3 * factor * v[i]) for m, v in signs.items()})],
        )
        for variant, factor in (("good", 0), ("slipped", 1))
        for i, scene in enumerate(DRAWN)
    ]
    content = study(name="suite", scenes={"drawn": 8, "seed": 1010})
    run = written_runs.results(content, cells)
    # Equal differences: the sums of signs are those of a binomial.
    p = {m: stats.binomtest(sum(x > 0 for x in v), 8).pvalue for m, v in signs.items()}
    (claim,) = judge(run, load_claims())
    (section,) = tabulated(run)
    rows = {row[1]: row for row in section.tables[-1].rows}
    # One claim, so its p-value is not multiplied; with the table's two others it would be by 3/1.
    assert rows[SLIP][5] == f"{number(p[SLIP])} †" == f"{number(claim.p)} †"
    assert (rows[SLIP][3], outcome(claim)) == ("worse", "holds")
    # The smaller of the table's two tests is doubled, the larger stays.
    assert p[recall] < p[precision]
    assert rows[recall][5] == number(2 * p[recall])
    assert rows[precision][5] == number(max(p[precision], 2 * p[recall]))
    assert any(text.startswith("† in the table") for text in section.text)


def test_a_baseline_that_was_not_measured_stays_in_the_table_and_is_named():
    (section,) = tabulated(results({"good": [None] * 3, "slipped": CLEAR["slipped"]}))
    run = results({"good": [None] * 3, "slipped": CLEAR["slipped"]})
    assert differences(run, compared_of(run, []))[0].text == ["**Slip: not measured: good.**"]
    assert [row[0] for row in section.tables[0].rows] == ["good", "slipped"]
    contrasts = section.tables[-1]
    assert {row[3] for row in contrasts.rows} <= {"not measured", "–"}


def test_a_variant_measured_on_fewer_scenes_says_so():
    run = results({"good": CLEAR["good"], "slipped": [[0.6, 0.6], None, [0.6, 0.6]]})
    assert differences(run, compared_of(run, []))[0].tables[0].rows[1][1] == "0.600 (2 scenes)"
    (section,) = tabulated(run)
    column = section.tables[0].columns.index("EPE on 64, layer px")
    assert section.tables[0].rows[1][column] == "0.600 (2 of 3 scenes)"


def test_differences_that_vanish_in_every_view_are_called_the_same_values_and_never_equal():
    (section,) = tabulated(results({"good": CLEAR["good"], "slipped": CLEAR["good"]}))
    row = next(row for row in section.tables[-1].rows if row[1] == SLIP)
    assert row[3] == "same values"


def test_only_its_own_study_judges_a_claim_and_the_expected_direction_holds():
    (told,) = judge(drawn(CLEARLY), [SLIP_CLAIM])
    assert (outcome(told), told.p, told.metric) == ("holds", 2 / 2**8, SLIP)
    assert (told.a, told.b) == ("good", "slipped")
    assert judge(drawn(CLEARLY, name="other"), [SLIP_CLAIM]) == []
    (opposite,) = judge(drawn(CLEARLY), [dataclasses.replace(SLIP_CLAIM, expect="lower")])
    assert outcome(opposite) == "the opposite holds"


PLAN = {"drawn": 8, "seed": 7, "size": 512}


@pytest.mark.parametrize(
    ("plan", "changes", "undone"),
    [
        ({"drawn": 9}, {}, 0),  # a scene more was planned
        ({"size": 256}, {}, 0),
        ({"seed": 8}, {}, 0),
        ({"seeds": [0, 1]}, {}, 0),
        ({}, {"scenes": list(DRAWN)}, 0),  # scenes of these names, not drawn
        ({}, {}, 1),  # a run that stopped
    ],
)
def test_a_claim_on_less_than_was_planned_is_not_finished_and_adjusts_no_other(
    plan, changes, undone
):
    whole = drawn(CLEARLY)
    claim = dataclasses.replace(SLIP_CLAIM, scenes=PLAN)
    assert [outcome(one) for one in judge(whole, [claim])] == ["holds"]
    run = written_runs.results(study(**changes), whole.cells) if changes else whole
    cells = [dataclasses.replace(cell, record=None) for cell in run.cells[:undone]]
    run = dataclasses.replace(run, cells=cells + run.cells[undone:])
    less = dataclasses.replace(SLIP_CLAIM, scenes={**PLAN, **plan})
    (told,) = judge(run, [less])
    assert told.verdict == "not finished"
    assert claims_section(run, [told]).tables[0].rows[0][1] == "not finished"
    both = judged([*measured(run, [less]), *measured(whole, [claim])])
    assert [one.p for one in both][1] == 2 / 2**8


@pytest.mark.parametrize(
    ("factors", "metric", "within", "verdict"),
    [
        # Of one sign in all scenes, so sure: p is 2 / 256.
        ([1.04] * 8, SLIP, "5 %", "more, by less than 5 %"),
        ([0.96] * 8, SLIP, "5 %", "less, by less than 5 %"),
        ([1.04] * 8, SLIP, "3 %", "better"),
        ([1.04] * 8, SLIP, None, "better"),
        # 0.1 to 0.104 is 0.4 points.
        ([1.04] * 8, "occlusion.recall", "1 %", "more, by less than 1 point"),
        # Of either sign in as many scenes: p is 1, and the interval holds 0.
        ([1.02, 0.98] * 4, SLIP, "5 %", "equal within 5 %"),
        ([1.02, 0.98] * 4, "occlusion.recall", "1 %", "equal within 1 point"),
        # Of one sign in seven of eight: p is 18 / 256, and the interval at 90 % lacks 0.
        ([1.02] * 7 + [0.98], SLIP, "5 %", "can't tell"),
    ],
)
def test_only_a_difference_that_may_be_none_is_equal_and_a_sure_one_is_less_than_the_bound(
    factors, metric, within, verdict
):
    cells = [
        cell(who, scene, [("v0", 0.0, {metric: value})])
        for scene, factor in zip(DRAWN, factors, strict=True)
        for who, value in (("good", 0.1), ("slipped", 0.1 * factor))
    ]
    run = written_runs.results(study(scenes={"drawn": 8, "seed": 7}), cells)
    claim = dataclasses.replace(SLIP_CLAIM, metric=metric, equal_within=within)
    (finding,) = judge(run, [claim])
    assert finding.verdict == verdict


WRONG = {"set": {"depth_agreement": False}}


def judged_beside(control, table=CLEARLY, expected="worse", **changes):
    """The claim's verdict beside a control of these figures; None where it was not measured."""
    table = table if control is None else {**table, "wrong": [control]}
    variants = {**study()["variants"], "wrong": WRONG}
    run = drawn(table, variants=variants, probes={"warp": list(variants)})
    claim = dataclasses.replace(SLIP_CLAIM, control={expected: WRONG}, **changes)
    (finding,) = judge(run, [claim])
    return finding


@pytest.mark.parametrize(
    ("factor", "control", "verdict"),
    [(1.5, "seen", "holds"), (1.0, "not seen", "blind"), (0.5, "not seen", "blind"),
     (None, "not measured", "can't tell")],
)  # fmt: skip
def test_a_claim_whose_control_does_no_worse_than_its_last_side_is_blind(factor, control, verdict):
    finding = judged_beside(factor and factor * np.array(CLEARLY["slipped"][0]))
    assert (finding.control.seen, outcome(finding)) == (control, verdict)


@pytest.mark.parametrize(("control", "verdict"), [(0.8, "holds"), (0.5, "blind")])
def test_a_control_that_reaches_more_than_half_of_a_gain_is_seen_and_the_claim_blind(
    control, verdict
):
    """Oracle: from an error of 0.9 px to one of 0.3 px, of which the control has a part."""
    wiggle = 0.001 * np.arange(8)
    table = {"good": [0.9 + wiggle], "slipped": [0.3 + wiggle]}
    finding = judged_beside(control + wiggle, table, expect="lower")
    share = (0.9 - control) / (0.9 - 0.3)
    assert finding.control.share == pytest.approx([share] * 3)
    assert (finding.control.seen, outcome(finding)) == ("seen", verdict)
    text = number(100 * share, 2)
    assert claim_row(finding)[-1] == f"seen: {text} % ({text} to {text} %)"


@pytest.mark.parametrize(
    ("expected", "verdict"), [("worse", "the opposite holds"), ("better", "blind")]
)
def test_wrong_features_that_do_as_well_explain_no_loss(expected, verdict):
    """True pictures that do no better do: the figure cannot tell good from bad."""
    table = {"good": [[0.5 + 0.01 * k for k in range(8)]], "slipped": [[0.1] * 8]}
    finding = judged_beside([0.1] * 8, table, expected)
    assert (finding.control.seen, outcome(finding)) == ("not seen", verdict)


def test_p_values_are_adjusted_over_the_claims_of_all_studies():
    """Oracle: Benjamini and Hochberg by hand: 4 / 256 of one, and 2 / 256 of another, of two."""
    (clear,) = CLEARLY["slipped"]
    runs = [drawn(CLEARLY | {"slipped": [row]}) for row in (clear, [*clear[:-1], 0.09])]
    both = [one for run in runs for one in measured(run, [SLIP_CLAIM])]
    assert [one.contrast.flips.p for one in both] == [2 / 256, 4 / 256]
    assert [one.p for one in judged(both)] == [4 / 256, 4 / 256]


@pytest.mark.parametrize(("count", "verdict"), [(8, "holds"), (5, "can't tell")])
def test_of_a_population_flipped_signs_decide_on_the_metrics_scale(count, verdict):
    names = [f"drawn-{k}" for k in range(count)]
    # A skewed difference, of the same sign in every scene: t cannot tell it.
    gains = [3.0**k for k in range(count)]
    cells = [
        written_runs.outcome("warp", scene, [who], record([value]), f"{who}-{scene}")
        for scene, gain in zip(names, gains, strict=True)
        for who, value in (("good", 0.1), ("slipped", 0.1 * (1 + gain)))
    ]
    content = study(scenes={"drawn": count, "seed": 7})
    run = written_runs.results(content, cells)
    (finding,) = judge(run, [SLIP_CLAIM])
    logs = np.log1p(gains)
    signs = np.array(list(itertools.product([1, -1], repeat=count)))
    expected = (np.abs(signs @ logs) >= logs.sum() - 1e-9).mean()
    assert finding.p == pytest.approx(expected) and outcome(finding) == verdict
    assert finding.contrast.student.p == pytest.approx(stats.ttest_1samp(logs, 0).pvalue)
    assert finding.contrast.shown()[0] == pytest.approx(np.exp(logs.mean()))


def test_a_claim_finds_its_sides_by_content_and_not_by_name():
    renamed = results(
        CLEAR, variants={"good": {"set": {"pixel_centers": "integer"}}, "slipped": {}}
    )
    (finding,) = measured(renamed, [SLIP_CLAIM])
    # The variant called "good" is the slipped one here, so the difference turns round.
    (named,) = measured(results(CLEAR), [SLIP_CLAIM])
    assert (finding.a, finding.b) == ("slipped", "good")
    assert finding.contrast.flips.mean == pytest.approx(-named.contrast.flips.mean)
    one = {"variants": {"good": {}}, "probes": {"warp": ["good"]}, "ablations": []}
    assert measured(results({"good": CLEAR["good"]}, **one), [SLIP_CLAIM]) == []


def needed(finding):
    verdict, reason = claim_row(finding)[1].split(": ")
    assert verdict == "can't tell"
    return int(re.fullmatch(r"(\d+) scenes would", reason)[1])


@pytest.mark.parametrize("claims", [1, 4])
def test_a_claim_that_cannot_be_told_says_how_many_scenes_would(claims):
    """Oracle: the level that Benjamini and Hochberg leave the largest of so many p-values, and
    scipy."""
    (finding,) = judge(drawn(HALF_TOLD), [SLIP_CLAIM])
    adjusted = dataclasses.replace(finding, p=min(1.0, claims * finding.p))
    level = 1 - 0.05 * finding.p / adjusted.p
    count = needed(adjusted)
    effect = np.log(UNSURE).mean() / np.log(UNSURE).std(ddof=1)
    assert power(count, effect, level) >= 0.8 > power(count - 1, effect, level)


def edited(
    name, value=0.0, *, done=True, scene="one", metric="embedding.dino_image.render", **spec
):
    source = Judgement("red", done, 30.0, 10.0, 10.0)
    extra = EditResult("red", "paint it red", source, source, {}, {}, 30.0, 2, 0.0)
    data = written_runs.record(
        [("red/v0", 15.0, {metric: value})],
        spec={"method": "attention_warping", "settings": {}, **spec},
        **extra.to_json(),
    )
    return written_runs.outcome("editing", scene, [name], data, f"{name}-{scene}")


def test_a_comparison_counts_the_source_edits_of_each_method_and_shows_those_of_the_control():
    cells = [
        edited("A", method="dge", done=False),
        edited("A", method="dge", done=True, scene="two"),
        edited("control", method="by_view"),
        edited("warped", done=False),
    ]
    names = ["A", "control", "warped"]
    run = written_runs.results(
        study(variants={name: {} for name in names}, probes={"editing": names}, ablations=[]), cells
    )
    (edits,) = abilities(run, "editing").tables
    (text,) = source_edits(run, "editing").text
    assert text.endswith("Done: 1 of 2: A; 1 of 1: control; 0 of 1: warped.")
    assert [row[3] for row in edits.rows] == ["control"]


def test_the_numbers_of_an_edit_decide_whether_it_is_done():
    """Oracle: the rule that the section states, read from its cells."""
    answer = {"view": np.full((4, 4, 3), 0.5)}
    unedited = {"view": np.full((4, 4, 3), 0.3)}
    inside = {"view": np.ones((4, 4), bool)}
    truth = EditTruth(unedited, {"red": answer}, {"red": inside}, inside)
    # Near the answer; nearer to the unedited picture; farther from the answer than that one is.
    expected = {0.45: "yes", 0.35: "**no**", 0.9: "**no**"}
    judged = {value: truth.judge({"view": np.full((4, 4, 3), value)}) for value in expected}
    for value, judgement in judged.items():
        extra = EditResult("red", "paint it red", judgement, judgement, {}, {}, 30.0, 2, 0.0)
        data = written_runs.record(
            [], spec={"method": "by_view", "settings": {}}, **extra.to_json()
        )
        cell = written_runs.outcome("editing", "one", ["control"], data, "a")
        content = study(variants={"control": {}}, probes={"editing": ["control"]}, ablations=[])
        section = abilities(written_runs.results(content, [cell]), "editing")
        row = dict(zip(section.tables[-1].columns, section.tables[-1].rows[0], strict=True))
        psnr, *limits = map(float, re.findall(r"[\d.]+", row["source, dB"]))
        decibels = [
            -20 * math.log10(abs(a - b)) for a, b in ((value, 0.5), (0.3, 0.5), (value, 0.3))
        ]
        assert [psnr, *limits] == pytest.approx(decibels, rel=5e-3)
        assert row["source done"] == expected[value]
        assert (psnr > max(limits)) == (row["source done"] == "yes")


@functools.cache
def shipped(name):
    """A study that claims name, whose scenes are drawn once."""
    return load_study(name)


@pytest.mark.parametrize("claim", load_claims(), ids=lambda claim: claim.id)
def test_the_study_that_judges_a_claim_measures_its_sides_and_its_control(claim):
    """Oracle: the study's YAML; a claim without a side or a control can never be told."""
    study, asked = shipped(claim.study), probe(claim.probe)
    control = {} if claim.control is None else claim.control
    for side in (claim.a, claim.b, control.get("worse"), control.get("better")):
        if side is None:
            continue
        wanted = parse_variant(dict(side))
        measured = [study.variants[label] for label in study.probes[claim.probe]]
        meant = asked.meaning(study, wanted)
        assert any(asked.meaning(study, variant) == meant for variant in measured), side


def test_every_claim_names_a_metric_of_its_probe_and_a_claim_only_once():
    declared = load_claims()
    assert len({claim.id for claim in declared}) == len(declared)
    for claim in declared:
        metric = probe(claim.probe).metric(claim.metric.replace("{layer}", "64"))
        # A bound in percent is of an error or a share, any other in the metric's unit.
        percent = metric.scale != "plain"
        assert claim.study and (
            claim.bound is None or isinstance(claim.equal_within, str) == percent
        )


def family(seed):
    return {"scenes": {"suite": {"seed": seed}, "suite-edits": {"seed": seed}}}


def test_a_claim_on_a_used_seed_is_refused(tmp_path, monkeypatch):
    (tmp_path / "used_seeds.yaml").write_text("1001: [suite, suite-edits]\n1002: [suite, pilot]\n")
    monkeypatch.setattr(claims, "USED", tmp_path / "used_seeds.yaml")
    for seed in (1001, 1003):
        claims.check_seeds(family(seed))
    for seed, who in ((1002, "pilot"), (1000, "earlier work")):
        with pytest.raises(InputError, match=f"suite: got seed {seed}, used by {who}; take one of"):
            claims.check_seeds(family(seed))


def test_the_list_of_used_seeds_has_every_seed_of_studies_and_reports():
    used = {int(seed) for seed in read_yaml(claims.USED.read_text())[1]}
    studies = [
        *(ROOT / "eval").glob("*/studies/*.yaml"),
        *(ROOT / "eval").glob("*/study/shipped/*.yaml"),
    ]
    found = {}
    for path in [*studies, *(ROOT / "reports").rglob("*.md")]:
        text = path.read_text()
        for pattern in (r"generator 1, seeds? (\d+)", r"drawn: \d+, [^}]*seed: (\d+)"):
            found |= {int(seed): path.name for seed in re.findall(pattern, text)}
    assert len(studies) > 15 and len(found) > 15
    assert {seed: name for seed, name in found.items() if seed not in used} == {}


def test_lines_of_the_readme_are_numbered_from_one_and_at_most_five():
    places = sorted({claim.headline for claim in load_claims() if claim.headline})
    assert places == list(range(1, len(places) + 1)) and len(places) <= 5


@pytest.mark.parametrize("name", sorted({claim.study for claim in load_claims()}))
def test_a_judging_study_draws_the_scenes_that_its_claims_declare(name):
    for claim in load_claims():
        assert claim.study != name or claim.planned(shipped(name))


def test_the_means_beside_a_claims_difference_are_over_the_views_that_both_sides_have():
    run = results(
        {
            "good": [[0.1, 9.0], [0.1, 0.3], [0.1, 0.1]],
            "slipped": [[0.6, None], [0.5, 0.7], [None, None]],
        }
    )
    (finding,) = measured(run, [SLIP_CLAIM])
    # Scene one without its second view, two whole, three left out; 9.0 would turn the order round.
    assert finding.means == pytest.approx(((0.1 + 0.2) / 2, (0.6 + 0.6) / 2))


def test_cells_of_more_than_one_state_of_the_code_are_told_apart(tmp_path):
    changed = {**written_runs.ENVIRONMENT, "git": {"sha": "b" * 40, "dirty": True}}
    cells = [
        written_runs.outcome("warp", "one", ["good"], record([0.1], {**changed, **more}))
        for more in ({}, {"source": "c" * 64}, {"source": "d" * 64})
    ]
    text = markdown(build(results(CLEAR, cells, ablations=[]), tmp_path))
    assert "more than one state of code" in text
    assert "6 cells with revision `aaaaaaaaaaaa`" in text
    # Two states with changes to one revision are two.
    local = "; 1 cell with revision `bbbbbbbbbbbb` with local changes"
    assert text.count(local) == 3
    assert f"{local} (source `cccccccccccc`)" in text
    assert f"{local} (source `dddddddddddd`)" in text


def test_two_scenes_that_agree_give_no_word_and_no_colour_of_a_verdict(tmp_path):
    cells = [
        written_runs.outcome("warp", scene, [name], record([value, value]), f"{scene}-{name}")
        for scene in ("one", "two")
        for name, value in (("good", 0.9), ("slipped", 0.1))
    ]
    made = build(written_runs.results(study(scenes=["one", "two"]), cells), tmp_path)
    row = next(r for s in made.sections for t in s.tables for r in t.rows if r[1] == SLIP)
    assert row[3] == "2 of 2 scenes lower; no verdict"
    words = re.compile(r"^(seen|not seen|mixed|better|worse|holds|can't tell|blind)$")
    cells = [
        c for s in made.sections for t in s.tables if not t.glossary for r in t.rows for c in r
    ]
    assert not [cell for cell in cells if words.match(cell)]


def test_a_study_of_one_scene_says_at_its_top_that_no_verdict_is_possible(tmp_path):
    cells = [
        written_runs.outcome("warp", "one", [name], record([value, value + 0.1]), name)
        for name, value in (("good", 0.1), ("slipped", 0.9))
    ]
    text = markdown(build(written_runs.results(study(scenes=["one"]), cells), tmp_path))
    lead = text[: text.index("\n## ")]
    assert "At 512 x 512 px, in scene one." in lead
    assert "One scene says nothing of others" in text and "one, two, three" not in text
    assert "means over the views of one scene, which has no interval" in text and "±" not in text
    # It is true: a difference of 0.8 in every view stays undecided.
    row = next(line for line in text.splitlines() if line.startswith(f"| slipped | {SLIP}"))
    assert "1 of 1 scene higher; no verdict" in row and "| in general |" not in text
    assert "One scene says" not in markdown(build(results(CLEAR), tmp_path))


@pytest.mark.parametrize(
    "differences, hangs",
    [
        # Of six equal signs p is 2 / 2**6, of five twice as much.
        ([0.5] * 6, 6),
        # A small one of eight against the others: 4 / 2**8; of seven 4 / 2**7, or 2 / 2**7.
        ([1.0] * 7 + [-0.01], 0),
        # A large one keeps it from being told: without it all signs are one.
        ([0.2] * 7 + [-3.0], 1),
    ],
)
def test_a_verdict_hangs_on_the_scenes_without_any_one_of_which_it_is_another(differences, hangs):
    """Oracle: the binomial distribution of signs."""
    sides = {f"s{k}": {"v": 5.0 + d} for k, d in enumerate(differences)}
    value = contrast({scene: {"v": 5.0} for scene in sides}, sides, "plain")
    claim = dataclasses.replace(SLIP_CLAIM, equal_within=None)
    (one,) = judged([Comparison("warp", SLIP, "good", "slipped", value, "higher", claim=claim)])
    assert one.hangs_on == hangs


def test_a_study_that_judges_claims_begins_with_their_verdicts():
    claims = [SLIP_CLAIM, dataclasses.replace(SLIP_CLAIM, text="It does not", expect="lower")]
    run = drawn(CLEARLY, title="What slips")
    section = claims_section(run, judge(run, claims))
    assert section.text[0] == (
        "2 claims are judged. As expected: 1. The opposite of what was expected: 1."
    )
    # The mean of the eight is 0.65 px.
    means = "0.65 px of a 64 grid against 0.10 px of a 64 grid"
    rows = [[*row[:2], row[3], *row[5:]] for row in section.tables[0].rows]
    assert rows == [
        ["It slips", "holds", means, "8 × 1", "0 of 8", "none"],
        ["It does not", "the opposite holds", means, "8 × 1", "0 of 8", "none"],
    ]
    assert section.text[1].startswith("Of 8 scenes drawn by generator")
    assert "for all 2 claims" in section.text[1]
    assert claims_section(results(CLEAR), judge(results(CLEAR), claims)) is None


def test_groups_that_would_not_fit_on_a_page_are_folded_and_named():
    many = [f"v{k}" for k in range(48)]
    groups = {"Few": ["slipped"], "Many": many, "Last": ["slipped"]}
    run = results(
        CLEAR,
        variants={**study()["variants"], **{name: {} for name in many}},
        probes={"warp": ["good", "slipped", *many]},
        ablations=[
            {"title": t, "probe": "warp", "baseline": "good", "variants": v}
            for t, v in groups.items()
        ],
    )
    (section,) = differences(run, compared_of(run, []))
    assert [table.folded for table in section.tables] == [False, True, True]
    assert section.text[-1].endswith("Many; Last.")


def test_a_short_table_has_each_main_figure_with_the_verdict_on_its_difference():
    """Oracle: means by hand; of eight scenes of one sign p is 2 / 256, of half of them 1."""
    table = {"good": [[0.1] * 8], "slipped": [[0.2 + 0.01 * k for k in range(8)]]}
    run = drawn(table, name="other")
    (short,) = differences(run, compared_of(run, []))[0].tables
    # Figures that no view has are left out.
    assert short.columns == ["variant", "EPE on 64, layer px"]
    (good, slipped) = short.rows
    assert good == ["good", "0.100 ± 0"]
    spacing = np.std([0.01 * k for k in range(8)], ddof=1)
    half = stats.t.ppf(0.975, 7) * spacing / math.sqrt(8)
    assert slipped == ["slipped", f"0.235 ± {number(half, 2)} worse"]
    assert glossary(run).startswith("**EPE on 64, layer px**: median endpoint error")
    unsure = drawn({**table, "slipped": [[0.1 + 0.01 * (-1) ** k for k in range(8)]]}, name="other")
    assert differences(unsure, compared_of(unsure, []))[0].tables[0].rows[1][1].count(" ") == 2


def test_a_study_that_asks_nothing_begins_with_what_was_measured(tmp_path):
    text = markdown(build(results(CLEAR, name="other"), tmp_path))
    first = text.split("\n", 1)[1].lstrip().split("\n")[0]
    assert first == (
        "For 2 variants, this run measured warps and masks against exact correspondences."
        " At 512 x 512 px, in scenes one, two, three."
    )
    # A claim that no study of this name judges is not missed, where nothing of it was measured.
    bare = written_runs.results(
        study(variants={}, probes={"stability": []}, ablations=[], scenes=[]), []
    )
    assert "claim" not in markdown(build(bare, tmp_path)).lower()


def test_a_method_whose_source_edit_failed_stands_in_no_ordering():
    """By hand: of scene two only ``A`` did its source edit."""
    metrics = (
        "embedding.dino_image.render",
        "embedding.clip_image.render",
        "image.psnr.edit_render",
    )
    for metric in metrics:
        cells = [
            edited("A", 0.5, metric=metric),
            edited("A", 0.7, metric=metric, scene="two"),
            edited("B", 0.4, metric=metric),
            edited("B", 0.9, metric=metric, scene="two", done=False),
        ]
        content = study(
            scenes=["one", "two"],
            variants={"A": {}, "B": {"options": {"stages": 1}}},
            probes={"editing": ["A", "B"]},
            ablations=[],
        )
        run = written_runs.results(content, cells)
        mean = run.mean("editing", "B", metric)
        assert (mean.mean, mean.scenes, mean.undefined) == (0.4, 1, 1)
        assert run.mean("editing", "A", metric).mean == pytest.approx(0.6)
        assert between(run, "editing", "A", "B", metric).by_scene == {"one": pytest.approx(-0.1)}


def calibrated(**changes):
    figures = {
        "warp.epe_median": 1e-13,
        "occlusion.f1.exact": 1.0,
        "calibration.mitsuba_agrees": 0.999,
        **changes,
    }
    data = written_runs.record([("v", 0.0, figures)])
    return written_runs.results(
        study(), [written_runs.outcome("calibration", "one", ["calibration"], data)]
    )


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"warp.epe_median": 2e-3}, "warp.epe_median is 0.00200, expected below 0.001 px"),
        ({"occlusion.f1.exact": 0.9999}, "expected 1"),
        ({"calibration.mitsuba_agrees": 0.9}, "expected at least 0.99"),
        ({"occlusion.f1.exact": None}, "undefined in every view"),
    ],
)
def test_an_instrument_that_is_off_is_reported(tmp_path, changes, says):
    assert problems(calibrated()) == []
    (problem,) = problems(calibrated(**changes))
    assert says in problem
    section, *_ = report_of("calibration").sections(calibrated(**changes), Layout(tmp_path))
    assert section.tables[0].rows[0][1] == "FAILED"
    told = build(calibrated(**changes), tmp_path).answer.text[0]
    assert "not calibrated" in told and says in told


def test_a_front_of_a_figure_that_no_view_has_says_so(tmp_path):
    title = {"title": "Cost", "variants": ["good", "slipped"]}
    front = [{**title, "probe": "warp", "metric": "warp.feature_all_accepted"}]  # without its grid
    (section,) = fronts(results(CLEAR, fronts=front), Layout(tmp_path))
    assert section.text[-1] == "Cost: no view has a value of `warp.feature_all_accepted`."
    assert not section.tables and not section.figures


def test_rounding_is_no_difference():
    """Differences of 5.6e-17 in every scene: the same values, as the p-value says."""
    table = {"good": [[0.3, 0.3]] * 3, "slipped": [[0.1 + 0.2, 0.1 + 0.2]] * 3}
    (claim,) = measured(results(table), [SLIP_CLAIM])
    assert claim.contrast.flips.p == 1.0


def test_a_front_never_puts_seconds_of_two_kinds_on_one_axis(tmp_path):
    front = [{"title": "Cost", "probe": "warp", "metric": SLIP, "variants": ["good", "slipped"]}]
    rounds = {"render": [[1.0] * 3] * 2, "pair": [[1.0, 2.0, 4.0], [1.0, 2.0, 4.0]]}
    data = written_runs.record([], spec={"rounds": 3, "views": ["v0"]}, cost={"rounds": rounds})
    timed = results(CLEAR, [written_runs.outcome("timing", "one", ["good"], data)], fronts=front)
    (section,) = fronts(timed, Layout(tmp_path))
    rows = {row[0]: row for row in section.tables[0].rows}
    assert rows["good"][2:] == ["2000", "1", "baseline", "yes"]
    assert rows["slipped"][2:] == ["–", "not timed", "–", "–"]
    assert rows["again"][3] == "1.00"  # three rounds have no interval
    once = results(CLEAR, fronts=front)
    (section,) = fronts(once, Layout(tmp_path))
    assert "one pass" in section.text[1]
    table = section.tables[0]
    assert {row[3] for row in table.rows} == {"one pass"}
    # Equally fast by one pass: the better is on its front, which says nothing more.
    assert table.columns[2] == "ms a view, one pass"
    assert [row[-1] for row in table.rows] == ["by one pass", "–"]
    assert [picture.caption for picture in section.figures] == ["Cost, one pass"]


def test_a_front_holds_variants_against_each_other_over_the_views_that_all_of_them_have(tmp_path):
    """Oracle: a reading view by view. Over their own views, "fast" would be better than "slow"."""
    values = {
        "slow": [[1.0, 5.0, 9.0], [2.0, 6.0, None], [3.0, 7.0, 11.0]],
        "fast": [[2.0, None, None], [3.0, 7.0, None], [4.0, None, None]],
        # 3 of the 8 views that "slow" has: too few.
        "rare": [[0.1, None, None], [None, 0.1, 0.1], [None, None, None]],
    }
    names = list(values)
    front = [{"title": "Cost", "probe": "warp", "metric": SLIP, "variants": names}]
    run = results(
        values, variants={n: {} for n in names}, probes={"warp": names}, ablations=[], fronts=front
    )
    means = {}
    for name in ("slow", "fast"):
        scenes = []
        for i in range(3):
            both = [j for j in range(3) if None not in (values["slow"][i][j], values["fast"][i][j])]
            scenes.append(sum(values[name][i][j] for j in both) / len(both))
        means[name] = sum(scenes) / len(scenes)
    assert means == pytest.approx({"slow": 8 / 3, "fast": 11 / 3})
    (section,) = fronts(run, Layout(tmp_path))
    rows = {row[0]: row for row in section.tables[0].rows}
    for name, mean in means.items():
        assert rows[name][1].startswith(f"{number(mean)} (")
    assert rows["rare"][1].endswith("own views")
    # Equally slow here, so only the better of the two is on the front.
    assert {name: row[-1] for name, row in rows.items()} == {
        "slow": "by one pass",
        "fast": "–",
        "rare": "–",
    }
    (text,) = [text for text in section.text if text.startswith("Cost: ")]
    assert "over the 4 of 9 views" in text and text.endswith("with most: rare.")


def test_text_of_a_page_is_escaped_before_it_is_set():
    assert (
        inline("a < b `c<d` **e** `#ff0000`")
        == 'a &lt; b <code>c&lt;d</code> <strong>e</strong> <span class="swatch"'
        ' style="background:#ff0000"></span>'
    )


def test_figures_that_papers_report_stand_in_one_table_with_rows_and_seconds():
    """Oracle: means of two scenes by hand."""
    source = Judgement("red", True, 30.0, 10.0, 10.0)
    extra = EditResult("red", "paint it red", source, source, {}, {}, 30.0, 2, 0.0)
    cells = []
    for scene, psnr, rows, seconds in (("one", 20.0, 100, 3.0), ("two", 22.0, 300, 5.0)):
        data = written_runs.record(
            [("red/v0", 15.0, {"image.psnr.edit_render": psnr})],
            spec={"method": "attention_warping", "settings": {}},
            cost={"seconds": {"whole": seconds}, "counters": {"network_rows": rows}},
            **extra.to_json(),
        )
        cells.append(written_runs.outcome("editing", scene, ["mine"], data, scene))
    content = study(
        scenes=["one", "two"], variants={"mine": {}}, probes={"editing": ["mine"]}, ablations=[]
    )
    (table,) = published(written_runs.results(content, cells), "editing").tables
    dashes = ["–"] * 3
    assert table.rows == [["mine", "2", "21.0 (20.0 to 22.0)", *dashes, "200", "4.00"]]


def test_a_tables_caption_says_what_its_own_rows_were_measured_on():
    editors = {"good": {"ideal": {"parts": 12, "colors": 4}}, "slipped": {"sha256": "e" * 64}}
    noise = {"good": "fresh", "slipped": "shared"}
    cells = [
        edited(
            name,
            scene=scene,
            splats={"kind": "2d"},
            settings={"noise": noise[name]},
            editor=editor,
            encoders={"clip": {"weights_sha256": "c" * 64}},
        )
        for scene in SCENES
        for name, editor in editors.items()
    ]
    run = written_runs.results(study(), cells)
    told = regime(run, Table(["variant"], [["`good`"]]))
    assert told == (
        "Study hand-made: scenes one, two, three; 512 x 512 px; seed 0. Figures are means over 3"
        " scenes of means over their views; brackets hold the lowest and the highest scene. So few"
        " give no verdict. Splats: sampled on the true surfaces. Noise of edited views: each view's"
        " own. Editors: SHA-256 eeeeeeeeeeee, the ideal editor (parts 12, colors 4). Encoder: clip"
        " cccccccccccc. Revision: `aaaaaaaaaaaa`."
    )
    both = regime(run, Table(["variant"], [["good"], ["slipped"]]))
    assert "Noise of edited views: each view's own; the same in all views in slipped." in both
