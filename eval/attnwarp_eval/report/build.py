"""Build of a report from a run's results: every section, in order."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from attnwarp_eval.document.model import Picture, Report, Section
from attnwarp_eval.document.numbers import FEWEST_SCENES
from attnwarp_eval.report.ablations import ablations, compared_of
from attnwarp_eval.report.answer import answer, by_claims, measured_in_words, question
from attnwarp_eval.report.claims import load_claims
from attnwarp_eval.report.commands import add_commands
from attnwarp_eval.report.controls import controls
from attnwarp_eval.report.fronts import TITLE as FRONTS
from attnwarp_eval.report.fronts import fronts
from attnwarp_eval.report.galleries import galleries
from attnwarp_eval.report.judging import claims_section, judge
from attnwarp_eval.report.measured import failures, measured
from attnwarp_eval.study.probe_report import Layout, Place, reports
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.schema import Study


def build(results: Results, root: Path, *, timings: bool = True, pictures: bool = True) -> Report:
    """The report's content; figures are written below ``root``/figures.

    Args:
        timings: whether measured seconds and memory are shown.
        pictures: whether the views' pictures are shown.
    """
    study = results.study
    total = len(results.cells)
    lead = [
        (
            f"Study `{study.name}`: {results.measured} of {total} cells measured,"
            f" {len(results.failures)} failed"
            + (
                f"; {study.scenes_in_words}; {study.size} x {study.size} px; seeds {study.seeds}."
                if study.scenes
                else "."
            )
        ),
    ]
    if study.scenes:
        alone = len(study.scenes) == 1
        lead.append(
            (
                "Figures are means over the views of one scene, which has no interval."
                if alone
                else f"Figures are means over {len(study.scenes)} scenes of means over their views;"
                + (
                    " brackets hold the lowest and the highest scene."
                    if len(study.scenes) < FEWEST_SCENES
                    else " ± half of the 95 % interval (Student's t over scenes)."
                )
            )
            + " Differences are paired on scene and view. Flipped signs of the scenes' differences"
            " decide, from six scenes on; verdicts are adjusted for the number of tests in their"
            ' table, those of claims for the number of claims. "can\'t tell" is not "equal".'
        )
        if alone and study.variants:
            lead.append(
                "**One scene says nothing of others. Name six scenes or more for a verdict.**"
            )
    for scene, lines in results.notices.items():
        # Formatted as code: names of files may have asterisks.
        lead += ["**Scene {}**: `{}`".format(scene, line.replace("`", "'")) for line in lines]
    layout = Layout(root, timings)
    claims = load_claims()
    judged = judge(results, claims)
    compared = compared_of(results, judged)
    of_probes: dict[Place, list[Section]] = {place: [] for place in Place}
    for own in reports():
        for place, section in own.sections(results, layout):
            of_probes[place].append(section)
    sections = [
        *of_probes[Place.ANSWER],
        *(
            [claims_section(results, judged)]
            if judged or any(claim.study == study.name for claim in claims)
            else []
        ),
        *(galleries(results) if pictures else []),
        *of_probes[Place.INSTRUMENT],
        *controls(results),
        *ablations(results, compared),
        *of_probes[Place.RESULT],
        *(fronts(results, layout) if timings else []),
        *failures(results),
        *of_probes[Place.APPENDIX],
        measured(results, timings),
    ]
    if not timings:
        for section in sections:
            section.tables = [table.without_timings() for table in section.tables]
    answered = answer(results, timings, pictures) or by_claims(results, judged, timings)
    if answered is None and of_probes[Place.ANSWER]:
        answered = sections.pop(0)
        answered.text[:0] = question(results)
    if answered is None:
        answered = Section("What was measured", [measured_in_words(results)])
    else:
        for section in sections:
            section.folded = True
        answered.figures += _front(study, sections)
    if faults := problems(results):
        told = "**The instrument is not calibrated; nothing below can be trusted:** "
        answered.text.insert(0, f"{told}{'; '.join(faults)}.")
    add_commands(results, sections)
    return Report(study.title or study.name, lead, sections, answered)


def _front(study: Study, sections: Sequence[Section]) -> list[Picture]:
    """The figure of the front whose metric decides the answer, by default of the first front."""
    figures = next((section.figures for section in sections if section.title == FRONTS), [])
    asked = study.answer
    column = None if asked is None else asked.columns[asked.decides]
    titles = [
        front.title
        for front in study.fronts
        if column is not None and (front.probe, front.metric) == (column.probe, column.metric)
    ]
    fitting = [f for f in figures if any(f.caption.startswith(title) for title in titles)]
    return (fitting or figures)[:1]


def problems(results: Results) -> list[str]:
    """Faults of the instrument in this run, one line each; empty if it is calibrated.

    Example:
        >>> from attnwarp_eval.study import parse_study
        >>> from attnwarp_eval.study.results import Results
        >>> content = dict(name="my", scenes=["spheres"], variants={"a": {}})
        >>> study = parse_study(content | {"probes": {"depth": ["a"]}})
        >>> problems(Results(study, cells=[], failures=[]))  # nothing measured, nothing wrong
        []
    """
    return [line for own in reports() for line in own.problems(results)]
