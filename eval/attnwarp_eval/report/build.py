"""Build of a report from a run's results: every section, in order."""

from __future__ import annotations

from pathlib import Path

from attnwarp_eval.document.model import Report, Section
from attnwarp_eval.report.ablations import compared_of, differences, in_detail
from attnwarp_eval.report.answer import answer, measured_in_words
from attnwarp_eval.report.claims import load_claims
from attnwarp_eval.report.commands import add_commands
from attnwarp_eval.report.controls import controls
from attnwarp_eval.report.fronts import fronts
from attnwarp_eval.report.galleries import galleries
from attnwarp_eval.report.judging import claims_section, judge
from attnwarp_eval.report.measured import failures, meanings, measured
from attnwarp_eval.study.probe_report import Layout, reports
from attnwarp_eval.study.results import Results


def build(results: Results, root: Path, *, timings: bool = True, pictures: bool = True) -> Report:
    """The report's content; figures are written below ``root``/figures."""
    layout = Layout(root, timings)
    judged = judge(results, load_claims())
    compared = compared_of(results, judged)
    of_probes = [section for own in reports() for section in own.sections(results, layout)]
    claims, answered = claims_section(results, judged), answer(results, timings, pictures)
    if answered is None:
        answered, claims = (
            claims or Section("What was measured", [measured_in_words(results)]),
            None,
        )
    sections = [
        *(section for section in of_probes if section.leads),
        *([] if claims is None else [claims]),
        *differences(results, compared),
        *controls(results),
        *in_detail(results, compared),
        *(section for section in of_probes if not section.leads),
        *(fronts(results, layout) if timings else []),
        *failures(results),
        measured(results),
        *(galleries(results) if pictures else []),
        meanings(results, timings),
    ]
    sections.sort(key=lambda section: section.folded)
    if not timings:
        for section in sections:
            section.tables = [table.without_timings() for table in section.tables]
    if faults := problems(results):
        told = "**The instrument is not calibrated; what it touches cannot be trusted:** "
        answered.text.insert(0, f"{told}{'; '.join(faults)}.")
    add_commands(results, sections)
    return Report(results.study.title or results.study.name, [], sections, answered)


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
