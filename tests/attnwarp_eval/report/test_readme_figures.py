"""Every figure of a measurement in README.md and reports/README.md, recomputed from raw results or a report's page."""

import json
import lzma
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from attnwarp_eval.statistics.contrasts import contrast

ROOT = Path(__file__).parents[3]
README = " ".join((ROOT / "README.md").read_text().split())
SEEN = ("ideal", "parts.seen.edit")
APART = ("editing", "multiview.delta_e_above.edit_inside")


@cache
def lines(study):
    (path,) = (ROOT / "reports" / study).glob("*.jsonl.xz")
    return [json.loads(one) for one in lzma.decompress(path.read_bytes()).decode().splitlines()]


def cells(study):
    return [one for one in lines(study) if one.get("record")]


def page(path):
    return (ROOT / "reports" / path).read_text()


def by_scene(study, probe, metric, variant, where=None):
    """Means over views, of the edit that has several right answers if edits differ; with ``where``
    over views where that figure isn't 0."""
    scenes = defaultdict(list)
    for one in cells(study):
        cell, record = one["cell"], one["record"]
        own = record.get("edit", {}).get("name") in (None, "some_colour")
        if own and cell["probe"] == probe and variant in cell["variants"]:
            views = [v["metrics"] for v in record["views"] if not where or v["metrics"][where]]
            values = [metrics.get(metric) for metrics in views]
            scenes[cell["scene"]] += [value for value in values if value is not None]
    return {scene: np.mean(values) for scene, values in scenes.items() if values}


def drifts():
    """Share of the gain over views alone that a picture moved by 2 px costs, by editor."""
    for figure, editor in ((SEEN, ", ideal"), (APART, "")):
        both = "attention warping", "each view alone"
        sides = [
            by_scene("drift-study", *figure, f"{method}{editor}, {px} px")
            for px in (0, 2)
            for method in both
        ]
        common = set.intersection(*map(set, sides))
        before, alone, after, alone_after = (
            np.mean([side[scene] for scene in common]) for side in sides
        )
        yield 100 * (1 - (after - alone_after) / (before - alone))


WHOLE_EDIT = r"whole edit \| \S+ \| (\S+) \| (.*?) \| (.*?) \| (\S+) \| (.*?) \|"
"""Its wall seconds, ratios of CPU and of wall seconds, cores, and the ratio of equal code."""


def start():
    """Seconds of the first edit."""
    seconds = float(in_page("editing/whole-edit.md", WHOLE_EDIT)[0])
    yield f"in [{seconds:.0f} seconds](reports/editing/whole-edit.md) on two cores"


def test_the_readme_prints_what_the_report_gives():
    assert all(phrase in README for phrase in start())


DEFINITIONS = (
    "each of 12 *parts* of a thing in one of 4 colours",
    "64 or 128 px",
    "2DGS",
    "3DGS",
    "dE00",
)
"""Numbers that are settings: parts, answers and their chance, sizes, names."""


def test_no_other_figure_stands_in_what_it_finds_and_what_it_cannot_do():
    """The lines between the marks are those of the verdicts, which test_verdicts.py recomputes."""
    text = README[README.index("## What it finds") :]
    before, _, rest = text.partition("<!-- headlines -->")
    text = before + rest.partition("<!-- /headlines -->")[2]
    for phrase in DEFINITIONS:
        text = text.replace(phrase, "")
    text = re.sub(r"\]\([^)]*\)|Apache License 2\.0", "", text)
    assert re.findall(r"[^.]*\d[^.]*", text) == []


# reports/README.md ----------------------------------------------------------------------------------------------------

REPORTS = " ".join((ROOT / "reports/README.md").read_text().split())


def in_page(path, pattern):
    """The groups of a pattern in a page, whose line breaks are spaces."""
    return re.search(pattern, " ".join(page(path).split())).groups()


def scenes_of(study):
    return len({one["cell"]["scene"] for one in cells(study)})


def masks_and_fits():
    """Rows on geometry, warps and masks."""
    hidden = in_page(
        "suite/report.md",
        r"(\S+ %) of what the paper's mask accepts is hidden from the source, (\S+ %) of",
    )
    (scenes,) = in_page("suite/report.md", r"means over (\d+) scenes")
    yield "{} of what the paper's mask accepts is hidden, and {} of what `corrected`".format(
        *hidden
    )
    yield f"over {scenes} drawn scenes"
    for metric in ("depth.abs_rel", "depth.normal_mean"):
        flat, solid = (by_scene("fitted", "fit", metric, f"{k}DGS fit") for k in (2, 3))
        assert np.mean([*flat.values()]) < np.mean([*solid.values()])
    yield f"closer through fitted 2DGS than through fitted 3DGS, on {scenes_of('fitted')} drawn"
    yield f"let in and throw away, on {scenes_of('visibility')} drawn scenes"
    fits = lines("iterations")[0]["study"]["variants"]
    few, most = (f(one["fit"]["iterations"] for one in fits.values()) for f in (min, max))
    yield f"What {few} to {most:,} iterations of a fit give"
    yield f"labels and pictures, on {scenes_of('iterations')} drawn scenes"
    yield f"lets more through, on {scenes_of('rules')} drawn scenes"
    (up,) = in_page("labels/report.md", r"\| exact depth \| labels.net \| \+(\S+) points")
    (down,) = in_page("labels/report.md", r"\| no mask \| labels.net \| -(\S+) points")
    yield (
        f"puts exact depth {up} points before `corrected`, and this {down} points before no mask,"
        f" on {scenes_of('labels')} drawn scenes"
    )
    scores = json.loads(lzma.decompress((ROOT / "reports/bench/unedited.json.xz").read_bytes()))
    of = {one["scene"] for one in scores["scores"]}
    yield f"{len(of)} drawn scenes of {scores['bench']['size']} px; nothing is judged"
    told = page("stability/report.md")
    assert "Every required level holds." in told
    sweeps = {row.split(" | ")[1] for row in re.findall(r"^\| \d+ \| .*$", told, re.MULTILINE)}
    yield f"Of {len(sweeps)} sweeps of hard inputs all hold"


def other_meshes():
    """Differences from `corrected` in two tables, told apart on meshes, and their signs in suite."""

    def table(path, caption):
        rows = page(path).split(f"**{caption}**\n\n")[1].split("\n\n")[0].splitlines()[2:]
        cut = [[cell.strip() for cell in row.strip("| ").split(" | ")] for row in rows]
        return {name: cells for name, *cells in cut}

    def gap(rows, name, column):
        value, base = (float(rows[one][column].split()[0]) for one in (name, "corrected"))
        return value > base

    signs = []
    for caption in (
        "Presets and rules of the mask",
        "Where the depth comes from, as the warp sees it",
    ):
        suite, meshes = (table(f"{name}/report.md", caption) for name in ("suite", "suite-meshes"))
        for name in suite.keys() & meshes.keys():
            for column, cell in enumerate(meshes[name]):
                if cell.endswith(("better", "worse")):
                    signs.append(gap(suite, name, column) == gap(meshes, name, column))
    assert all(signs)
    (scenes,) = in_page("suite-meshes/report.md", r"means over (\d+) scenes")
    yield f"The {len(signs)} differences of warps that are told apart on {scenes} scenes"


def edits():
    """Rows on edits."""
    shares = [
        np.mean([*by_scene("kinds", *SEEN, each).values()]) for each in ("by kind", "both late")
    ]
    yield "early bring {:.0%} of the parts to the source's answer, both late {:.0%}".format(
        *shares
    ).replace("%", " %")
    edge, exact = (
        in_page("depth-edges/report.md", rf"\| {name} \| [^|]* \| [^|]* \| -(\d+) points")[0]
        for name in ("corrected", "exact geometry")
    )
    yield f"right {edge} points less often at a depth edge than away, and those of exact geometry {exact}"
    yield (
        "by 2 px costs attention warping {:.0f} % of its gain with the ideal editor, and {:.0f} %"
    ).format(*drifts())
    for study in ("ablation", "comparison"):
        yield f"at {lines(study)[0]['study']['size']} px"
    row = in_page("editing/time.md", r"\| default \| (?:[^|]* \| ){7}(\d+) \| (\d+), ")
    yield "An edit of {1} views, fit included, takes {0} s".format(*row)


def instruments():
    """Rows on metrics and truth, and what the audit says of encoders."""
    yield f"can be believed, on {scenes_of('audit')} drawn scenes"
    yield f"[at {lines('audit-256')[0]['study']['size']} px](audit-256/report.md)"
    scenes, certified = in_page(
        "effects/effects.md", r"(\d+) scenes, (\d+) of their plans certified"
    )
    yield f"with proofs: {certified} of {scenes} plans are certified"
    (flaws,) = in_page("audit/report.md", r"sees, of (\d+) flaws")

    def blind(name):
        (listed,) = in_page("audit/report.md", rf"\| {name} \| [^|]* \| [^|]* \| ([^|]*) \|")
        return len(listed.split(", "))

    yield f"similarity to words blind to {blind('CLIP similarity')} of {flaws} flaws"
    yield f"its directional similarity to {blind('CLIP directional similarity')}"
    (seen,) = in_page("audit/report.md", r"\| DINO between neighbours \| [^|]* \| (\d+): ")
    yield f"DINO between neighbours sees {seen}."
    (most,) = in_page("scale/report.md", r"(100,000)")
    yield f"[{most} cells](scale/report.md)"


ROWS = (masks_and_fits, other_meshes, edits, instruments)


@pytest.mark.parametrize("topic", ROWS)
def test_the_table_of_reports_prints_what_they_give(topic):
    missing = [phrase for phrase in topic() if phrase not in REPORTS]
    assert missing == []


def test_no_other_figure_stands_in_the_table_of_reports():
    """The block between the marks is that of the verdicts, which test_verdicts.py recomputes."""
    text = REPORTS.partition("<!-- /verdicts -->")[2]
    for phrase in [
        *(phrase for topic in ROWS for phrase in topic()),
        *DEFINITIONS,
        "3DGS",
        "0.5 dB",
    ]:
        text = text.replace(phrase, "")
    text = re.sub(r"\]\([^)]*\)|`[^`]*`|\b[0-9a-f]{8}\b", "", text)
    assert re.findall(r"[^.]*\d[^.]*", text) == []


def test_there_are_at_most_25_reports_a_row_is_one_sentence_and_each_link_is_there():
    folder, text = ROOT / "reports", page("README.md").partition("<!-- /verdicts -->")[2]
    tables = text.partition("## Which seconds")[0]
    rows = re.findall(r"^\| \[([\w-]+)\]\(\S+\) \| (.*) \|$", tables, re.MULTILINE)
    assert 20 <= len(rows) <= 25
    for name, said in rows:
        assert said.endswith((".", ")")) and len(re.findall(r"\. [A-Z]", said)) == 0, name
    linked = re.findall(r"\]\(([^)#]+)[^)]*\)", page("README.md"))
    assert [link for link in linked if not (folder / link).exists()] == []
    named = {link.split("/")[0] for link in linked if not link.startswith("..")}
    assert {path.name for path in folder.iterdir() if path.is_dir()} == named


# docs/method/fitting.md -----------------------------------------------------------------------------------------------


def iterations():
    """CPU seconds and depth errors, over the scenes that have all four numbers of iterations."""
    names, seconds = ("300", "1,000", "3,000", "7,000"), defaultdict(dict)
    for one in cells("iterations"):
        if one["cell"]["probe"] == "fit":
            point = one["record"]["curve"][-1]
            seconds[one["cell"]["variants"][0]][one["cell"]["scene"]] = point["cpu_seconds"]
    scenes = sorted(set.intersection(*(set(seconds[name]) for name in names)))
    depth = {name: by_scene("iterations", "fit", "depth.abs_rel", name) for name in names}
    taken, left = (
        [np.mean([figures[name][scene] for scene in scenes]) for name in names]
        for figures in (seconds, depth)
    )
    yield (
        f"on {len(scenes)} drawn scenes of 128 px, 300, 1,000, 3,000 and 7,000 iterations take"
        " {:.0f}, {:.0f}, {:.0f} and {:.0f} CPU seconds and leave a depth error of"
        " {:.1f}, {:.1f}, {:.1f} and {:.1f} %"
    ).format(*taken, *(100 * each for each in left))
    ratios = [np.log(depth["3,000"][scene] / depth["7,000"][scene]) for scene in scenes]
    half = stats.t.ppf(0.975, len(ratios) - 1) * stats.sem(ratios)
    more = [100 * np.expm1(np.mean(ratios) + part) for part in (0, -half, half)]
    yield "that of 3,000 is larger by {:.0f} % ({:.0f} to {:.0f} %)".format(*more)


def harmonics():
    """Savings and costs of a later degree of the harmonics."""
    rows = [json.loads(line) for line in page("iterations/harmonics.jsonl").splitlines()]

    def ratio(figure, scene):
        late, early = (
            np.mean([row[figure] for row in rows if (row["scene"], row["sh_every"]) == (scene, s)])
            for s in (0.25, 0.14)
        )
        return 100 * (late / early - 1)

    scenes = sorted({row["scene"] for row in rows})
    saved = -np.mean([ratio("cpu_seconds", scene) for scene in scenes])
    costs = [ratio("depth.abs_rel", scene) for scene in scenes]
    yield f"0.25 saves {saved:.0f} % of the CPU seconds of 2,000 iterations"
    yield "depth error {:.0f} and {:.0f} % larger".format(*costs)


def default_of_an_edit():
    """Loss by half of the steps, and of the tuning, of an edit."""

    def loss(metric, first, second, *studies, where=None):
        a, b = (
            {
                (study, scene): {"": value}
                for study in studies
                for scene, value in by_scene(study, "ideal", f"parts.{metric}", each, where).items()
            }
            for each in (first, second)
        )
        return contrast(a, b, "plain")

    studies = ("default-reported", "steps-reported")
    several = [f"several answers: {n} steps" for n in (20, 10)]
    both, first = (
        loss("delta_e.edit", *several, *studies),
        loss("delta_e.edit", *several, studies[0]),
    )
    said = "{:.2f} dE00 [{:.2f}, {:.2f}]"
    yield f"on {both.scenes} drawn scenes"
    yield f"by {said.format(*both.shown(0.9))} with several right answers"
    yield f"on the first {first.scenes} it was {said.format(*first.shown(0.9))}"
    one = loss("delta_e.edit", *(f"one answer: {n} steps" for n in (20, 10)), studies[0])
    yield f"by {one.shown(0.9)[0]:.2f} with one"
    tuned = "several answers: 20 steps, tuned", "several answers: 10 steps, tuned half as long"
    yield f"renders by {said.format(*loss('delta_e.render', *tuned, studies[0]).shown(0.9))}"
    arms = "3 x 300 iterations", "default"

    def nearer(found):
        mean, low, high = found.shown(0.9)
        return said.format(-mean, -high, -low)

    now = loss("delta_e.render", *arms, "lift-reported")
    old, new = (by_scene("lift-reported", "ideal", "parts.delta_e.render", arm) for arm in arms)
    yield f"[{now.scenes} drawn scenes](../../reports/lift-reported/report.md)"
    yield f"source's answer by {nearer(now)} (ideal editor, several right answers, 90 %)"
    yield f"in {sum(new[scene] < old[scene] for scene in old)} scenes"
    large = loss("delta_e.render", *arms, "lift-reported", where="parts.seen_parts.render")
    yield f"16 px of a part it is {nearer(large)}"
    outside = loss("bleed.render", *arms, "lift-reported").shown(0.9)
    yield f"farther from the picture by {said.format(*outside)}"
    ideal = [f"ideal: {arm}" for arm in arms]
    first = loss("delta_e.render", *ideal, "tuning-reported")
    yield f"on its {first.scenes} scenes renders came nearer by {nearer(first)}"
    old, new = (by_scene("tuning-reported", "ideal", "parts.delta_e.render", arm) for arm in ideal)
    yield f"lost {max(new[scene] - old[scene] for scene in old):.1f} dE00"
    one, new_one, many, new_many = re.findall(
        r"^\| (?:3 x 300 iterations|default) \|.*\| ([\d.]+)[^|]*\| (0\.\d+)[^|]*\|$",
        page("tuning-reported/report.md"),
        re.MULTILINE,
    )
    yield f"have {new_one[0]} dB to the true edit for {one[0]} (one right answer)"
    yield f"and {new_many[0]} dB for {many[0]} (several)"
    yield f"errs by {new_one[1]} for {one[1]}"
    cpu, wall, cores, same = in_page("editing/whole-edit.md", WHOLE_EDIT)[1:]
    yield f"[{cpu} of its CPU seconds and {wall} of its wall seconds]"
    yield f"equal code differs by {same}. {cores} of two cores are busy"
    row = r"\| dinosaur \| \S+ \| \S+ \| (\S+) [^|]*\| (\S+) "
    cpu, wall = in_page("editing/whole-edit.md", row)
    yield f"The dinosaur costs {cpu} and {wall}, in two rounds"


def test_the_page_on_time_prints_what_the_default_of_an_edit_loses():
    told = " ".join((ROOT / "docs/measuring/accuracy-and-time.md").read_text().split())
    assert [phrase for phrase in default_of_an_edit() if phrase not in told] == []


@pytest.mark.parametrize("topic", [iterations, harmonics])
def test_the_page_on_fits_prints_what_was_measured(topic):
    told = " ".join((ROOT / "docs/method/fitting.md").read_text().split())
    assert [phrase for phrase in topic() if phrase not in told] == []


# docs/method/algorithm.md, docs/measuring/evidence.md -----------------------------------------------------------------


def parts(region, *variants):
    """Shares of the parts with the source's colour, in percent, by scene."""
    metric = f"multiview.same_part.{region}"
    return [by_scene("parts", "carry", metric, each) for each in variants]


def test_the_pages_on_the_method_and_on_evidence_print_what_an_editor_in_parts_gives():
    method, evidence = (
        " ".join((ROOT / f"docs/{path}.md").read_text().split())
        for path in ("method/algorithm", "measuring/evidence")
    )
    names = "default", "unseen: free", "each view alone"
    shares = [np.mean([*of.values()]) for of in parts("unseen", *names)]
    said = "in {:.0%} of the cases by the default, in {:.0%} edited freely there (`unseen=free`), and in {:.0%} in"
    assert said.format(*shares).replace("%", " %") in method
    assert f"On [{scenes_of('parts')} drawn scenes](../../reports/parts" in method
    seen = parts("seen", "default", "each view alone", "mirrored")
    default, alone, mirrored = (np.array([of[scene] for scene in seen[0]]) for of in seen)
    assert f"brings {100 * default.mean():.0f} % of a thing's parts to" in evidence
    assert f"by the default and {100 * alone.mean():.0f} % alone" in evidence
    share = (mirrored - alone).mean() / (default - alone).mean()
    (told,) = in_page("parts/report.md", r"mirrored places reach (\S+ % \([^)]*\)) of the gain")
    assert (
        told.startswith(f"{100 * share:.0f} % (") and f"mirrored places reach {told} of" in evidence
    )


# docs/measuring/accuracy-and-time.md ----------------------------------------------------------------------------------


def timed(study, stage):
    """Variant -> seconds of a stage: medians over the rounds in turn, means over the timed scenes."""
    seconds = defaultdict(list)
    for one in cells(study):
        if one["cell"]["probe"] == "timing":
            rounds = one["record"]["cost"]["rounds"][stage]
            for name, own in zip(
                one["cell"]["variants"], rounds, strict=False
            ):  # then the first again
                seconds[name].append(np.median(own))
    return {name: np.mean(own) for name, own in seconds.items()}


def measured(study, probe, metric, seconds):
    """(variant, error, seconds), the error a mean over scenes."""
    found = {name: by_scene(study, probe, metric, name).values() for name in seconds}
    return [(name, np.mean([*own]), seconds[name]) for name, own in found.items()]


def edits():
    """The edits whose source view shows a right answer by every variant."""
    seconds, errors = timed("time-reported", "whole"), defaultdict(dict)
    for one in cells("time-reported"):
        if one["cell"]["probe"] == "editing" and one["record"]["edit"]["source"]["done"]:
            views = [
                view["metrics"]["fidelity.mse.render_inside"] for view in one["record"]["views"]
            ]
            own = one["cell"]["scene"], one["record"]["edit"]["name"]
            errors[one["cell"]["variants"][0]][own] = np.mean([x for x in views if x is not None])
    common = set.intersection(*map(set, errors.values()))
    assert len(common) == 6
    return [
        (name, np.sqrt(np.mean([of[one] for one in common])), seconds[name])
        for name, of in errors.items()
    ]


def fits():
    taken = defaultdict(dict)
    for one in cells("iterations"):
        if one["cell"]["probe"] == "fit":
            point = one["record"]["curve"][-1]
            taken[one["cell"]["variants"][0]][one["cell"]["scene"]] = point["cpu_seconds"]
    scenes = set.intersection(*map(set, taken.values()))
    for name, seconds in taken.items():
        depth = by_scene("iterations", "fit", "depth.abs_rel", name)
        yield (
            f"{name} iterations",
            *(np.mean([of[one] for one in scenes]) for of in (depth, seconds)),
        )


def pictures():
    """The plan's samples: error and seconds in the median of the scenes."""
    found = defaultdict(list)
    for panel in json.loads(page("accuracy/accuracy.json"))["panels"]:
        for one in panel["contestants"] if panel["question"] == "pictures" else ():
            if re.fullmatch(r"plan, \d+ spp", one["name"]):
                found[one["name"]].append((one["error"][0], np.median(one["seconds"])))
    return [(name, *np.median(own, axis=0)) for name, own in found.items()]


def choices():
    """The tables: what is cheapest for an error."""
    warps = timed("suite", "pair")
    tables = {
        "of the features that a warp accepts": (
            measured("suite", "warp", "warp.feature_all_accepted.32", warps), "{:.0%}", "ms", 1000,
        ),
        "of the depth of a fit": (fits(), "{:.1%}", "CPU s", 1),
        "of an edit's renders to the true edit, RMS": (edits(), "{:.3f}", "s", 1),
        "of a pixel of the true pictures, RMS": (pictures(), "{:.0%}", "ms", 1000),
    }  # fmt: skip
    for what, (points, form, unit, factor) in tables.items():
        yield f"| for an error {what}, of | take | {unit} |\n|---|---|---|"
        best = np.inf
        for name, error, seconds in sorted(points, key=lambda point: point[2]):
            if error < best:
                best, told = error, form.format(error).replace("%", " %")
                yield f"| {told} | {name} | {factor * seconds:.3g} |"
        yield ""


def test_the_page_on_accuracy_and_time_has_the_cheapest_choice_for_an_error():
    told = (ROOT / "docs/measuring/accuracy-and-time.md").read_text()
    assert "\n".join(choices()).strip() in told
    told = " ".join(told.split())
    by = {name: f"to {error:.3f} in {seconds:.3g} s" for name, error, seconds in edits()}
    assert f"An edit's default comes {by['default']}." in told
    assert f"300 iterations a stage, comes {by['20 steps, tuned as before']}, and" in told
    assert f"views edited alone {by['each view alone']}." in told
