"""Every figure of a measurement in README.md and reports/README.md, recomputed from raw results or a report's page."""

import json
import lzma
import re
from collections import defaultdict
from functools import cache
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from scipy import stats

ROOT = Path(__file__).parents[3]
README = " ".join((ROOT / "README.md").read_text().split())
COLOR = ("ideal", "parts.delta_e.edit")
SEEN, KEPT = ("ideal", "parts.seen.edit"), ("warp", "occlusion.recall")
ANSWER = ("editing", "multiview.same_answer.edit")
APART = ("editing", "multiview.delta_e_above.edit_inside")

SENTENCES = [
    ("fitted/undensified", SEEN, ["2DGS fit, extended"], "`extended` brings [{:.0%}]"),
    ("fitted/undensified", SEEN, ["2DGS fit", "3DGS fit, extended", "3DGS fit"], "`corrected` {:.0%} (3DGS: {:.0%} and {:.0%})"),
    ("fitted/undensified", SEEN, ["2DGS fit, each view alone"], "each view alone {:.0%}, `extended` with exact"),
    ("fitted/undensified", SEEN, ["exact depth and mask"], "depth and mask {:.0%} (24 scenes"),
    ("fitted/undensified", KEPT, ["2DGS fit, tolerant", "2DGS fit"], "mask keeps {:.0%} of what is visible there, that of `corrected` {:.0%}"),
    ("kinds", SEEN, ["by kind", "both late", "each view alone"], "It brings {:.0%} of these parts to the source's answer, its former weights {:.0%}, each view alone {:.0%}"),
    ("kinds", COLOR, ["by kind", "both late"], "colours are off by {:.1f} for {:.1f} dE00"),
    ("kinds", COLOR, ["one answer: by kind", "one answer: both late"], "views are {:.2f} dE00 from it, as each view alone, for {:.2f} before"),
    ("kinds", ("ideal", "parts.through.edit"), ["by kind", "both late"], "does not see {:.0%} show what stands before it, for {:.0%}"),
    ("ablation", ANSWER, ["shared: corrected"], "[{:.0%}](reports/ablation/report.md) with carried features and without"),
    ("ablation", ANSWER, ["shared: each view alone"], "[{:.0%}](reports/ablation/report.md) with carried features and without"),
    ("ablation", APART, ["shared: each view alone", "shared: corrected"], "differ more alone, by {:.1f} for {:.1f} dE00"),
]  # fmt: skip


@cache
def lines(study):
    (path,) = (ROOT / "reports" / study).glob("*.jsonl.xz")
    return [json.loads(one) for one in lzma.decompress(path.read_bytes()).decode().splitlines()]


def cells(study):
    return [one for one in lines(study) if one.get("record")]


def page(path):
    return (ROOT / "reports" / path).read_text()


def by_scene(study, probe, metric, variant):
    """Means over views, of the edit that has several right answers if edits differ."""
    scenes = defaultdict(list)
    for one in cells(study):
        cell, record = one["cell"], one["record"]
        own = record.get("edit", {}).get("name") in (None, "some_colour")
        if own and cell["probe"] == probe and variant in cell["variants"]:
            values = [view["metrics"].get(metric) for view in record["views"]]
            scenes[cell["scene"]] += [value for value in values if value is not None]
    return {scene: np.mean(values) for scene, values in scenes.items() if values}


def means():
    """Means of variants, and the number of scenes that they are over."""
    for study, figure, variants, sentence in SENTENCES:
        values = [np.mean([*by_scene(study, *figure, each).values()]) for each in variants]
        yield sentence.format(*values).replace("%", " %")
    assert len(by_scene("fitted/undensified", *SEEN, "2DGS fit")) == 24
    edited = by_scene("ablation", *ANSWER, "shared: corrected")
    every = {one["cell"]["scene"] for one in cells("ablation")}
    yield f"over the {len(edited)} of {len(every)} scenes whose source was edited"
    alone = by_scene("kinds", *COLOR, "one answer: each view alone")
    assert round(np.mean([*alone.values()]), 2) == 0.20
    yield f"[{len(alone)} scenes](reports/kinds/report.md)"


def drifts():
    """Shares of the gain over views alone that a moved picture costs."""
    counts = []

    def lost(figure, editor, shift):
        both = "attention warping", "each view alone"
        sides = [
            by_scene("drift-study", *figure, f"{method}{editor}, {px} px")
            for px in (0, shift)
            for method in both
        ]
        common = set.intersection(*map(set, sides))
        counts.append(len(common))
        before, alone, after, alone_after = (
            np.mean([side[scene] for scene in common]) for side in sides
        )
        return 100 * (1 - (after - alone_after) / (before - alone))

    small, large = ([lost(SEEN, ", ideal", shift), lost(APART, "", shift)] for shift in (2, 8))
    size = lines("drift-study")[0]["study"]["size"]
    yield f"A shift of 2 px in {size} costs attention warping [{small[0]:.0f} %]"
    yield f"with the ideal editor, {small[1]:.0f} % with a bundled one"
    yield "8 px cost {:.0f} % and {:.0f} %".format(*large)
    assert counts[0] == counts[2]
    low, high = sorted((counts[1], counts[3]))
    yield f"({counts[0]} scenes, {low} or {high} of them with the bundled editor"


def metrics():
    """Figures that were audited, and scenes in which a blurred set scores higher."""

    def higher(flaw):
        scenes = defaultdict(list)
        for one in cells("audit"):
            if one["cell"]["probe"] == "audit":
                values = one["record"]["views"][0]["metrics"]
                right, blurred = (
                    values[f"consistency.fitted_psnr.fitted.{name}"] for name in ("right", flaw)
                )
                scenes[one["cell"]["scene"]].append(blurred > right)
        return sum(map(all, scenes.values())), len(scenes)

    rows = re.findall(r"^\| ([^|]*?) \| [^|]* \| \d+: ", page("audit/report.md"), re.MULTILINE)
    # Of one figure there are rows by exact, rendered and fitted depth.
    figures = {
        re.sub(r", (depth( of fitted splats)?|fitted splats|exact)$", "", row)
        for row in rows
        if not row.startswith("truth:")
    }
    one_blurred, scenes = higher("blur=1")
    yield f"of {len(figures)} figures on {scenes} drawn scenes"
    yield (
        f"scores higher than the right edit in {one_blurred} of {scenes} scenes if one view is"
        " blurred by 1 px"
    )
    assert higher("blur_all=2") == (scenes, scenes)
    yield "and in all if every view is blurred by 2 px"


def tracks():
    """Medians of the tracks of neighbouring views."""
    files = [json.loads(page(f"tracks/bear-{kind}dgs.json")) for kind in "23"]
    medians = {
        preset: [
            row["figures"]["median"]["value"]
            for file in files
            for row in file["rows"]
            if (row["preset"], row["apart"], row["views"]) == (preset, 1, "all")
        ]
        for preset in ("paper", "corrected")
    }
    yield "{:.2f} against {:.2f} px between neighbouring".format(*medians["paper"])
    yield "both are at {:.2f} to {:.2f} px".format(*medians["corrected"])


def light():
    """Median prices of full light within the scenes' bounces."""
    scenes = json.loads(page("effects/effects.json"))["scenes"]
    caps = [scene["cost"].get("cap") or scene["cost"] for scene in scenes]
    same_error = median(cap.get("at_equal_error", cap.get("at_equal_noise")) for cap in caps)
    same_samples = median(cap["faster"] for cap in caps)
    yield f"takes [{same_error:.1f} times as long]"
    yield (
        f"to the same error, and {same_samples:.1f} times with the same samples, in the median of"
        f" {len(scenes)} hand-made scenes"
    )


def hard_inputs():
    """Sweeps of hard cases, and how many of them end."""
    told, ends = page("stability/report.md"), defaultdict(bool)
    for row in re.findall(r"^\| \d+ \| .*$", told, re.MULTILINE):
        _, name, *_, end, _ = row.split(" | ")
        ends[name] |= end != "–"  # forward and backward
    assert "Every required level holds." in told
    assert 0.2 < np.mean([*ends.values()]) < 0.3
    yield f"tried in [{len(ends)} sweeps]"


def start():
    """Seconds of the first edit."""
    row = re.search(r"`attnwarp edit bear .*?` \| (\d+) \|", page("first-hour/report.md"))
    assert round(int(row[1]) / 60) == 2
    yield "in [two minutes](reports/first-hour/report.md) on two cores"


TOPICS = (means, drifts, metrics, tracks, light, hard_inputs, start)


@pytest.mark.parametrize("topic", TOPICS)
def test_the_readme_prints_what_the_reports_give(topic):
    missing = [phrase for phrase in topic() if phrase not in README]
    assert missing == []


DEFINITIONS = (
    "each of 12 *parts* of a thing in one of 4 colours", "in 25 % of cases", "In lines 1 to 3", "in line 4",
    "on the 14 of", "two captures", "64 or 128 px", "from 2026", "rivals of 2026", "2DGS", "3DGS", "dE00",
)  # fmt: skip
"""Numbers that are settings: parts, answers and their chance, sizes, names."""


def test_no_other_figure_stands_in_what_it_finds_and_what_it_cannot_do():
    """The lines between the marks are those of the verdicts, which test_verdicts.py recomputes."""
    text = README[README.index("## What it finds") :]
    before, _, rest = text.partition("<!-- headlines -->")
    text = before + rest.partition("<!-- /headlines -->")[2]
    for phrase in [*(phrase for topic in TOPICS for phrase in topic()), *DEFINITIONS]:
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
    yield f"Of {scenes_of('fitted')} drawn scenes, normals are closer"
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
    one, three = in_page(
        "masks/report.md", r"does not show it is (\d+ %) and .* around the scene give (\d+ %)"
    )
    yield f"overlaps its thing by {one} at 60 degrees, and three masks by {three}"
    scores = json.loads(lzma.decompress((ROOT / "reports/bench/unedited.json.xz").read_bytes()))
    of = {one["scene"] for one in scores["scores"]}
    yield f"{len(of)} drawn scenes of {scores['bench']['size']} px; nothing is judged"
    (sweeps,) = hard_inputs()
    yield f"Of {re.search(r'[0-9]+', sweeps)[0]} sweeps of hard inputs all hold"


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
    yield f"[at {lines('ideal-256')[0]['study']['size']} px](ideal-256/report.md)"
    edge, exact = (
        in_page("depth-edges/report.md", rf"\| {name} \| [^|]* \| [^|]* \| -(\d+) points")[0]
        for name in ("corrected", "exact geometry")
    )
    yield f"right {edge} points less often at a depth edge than away, and those of exact geometry {exact}"
    ideal, bundled = (re.findall(r"(\d+) %", told)[0] for told in [*drifts()][:2])
    yield f"by 2 px costs attention warping {ideal} % of its gain with the ideal editor, and {bundled} %"
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


@pytest.mark.parametrize("topic", [iterations, harmonics])
def test_the_page_on_fits_prints_what_was_measured(topic):
    told = " ".join((ROOT / "docs/method/fitting.md").read_text().split())
    assert [phrase for phrase in topic() if phrase not in told] == []
