"""Measurement of a run: metrics, code, machine, seconds; and failed cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from typing import Any

from attnwarp_eval.document.model import Section, Table
from attnwarp_eval.document.numbers import FEWEST_SCENES, number
from attnwarp_eval.report.ablations import glossary
from attnwarp_eval.study.computations import alike
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.record import Record
from attnwarp_eval.study.results import Results
from attnwarp_eval.study.shared.splats import is_fitted

NOISE = {
    "fresh": "each view's own",
    "shared": "the same in all views",
    "surface": "one that sticks to the surface",
}
"""Setting of the noise -> its wording."""

STAGES = ("setup", "truth", "splats", "method", "sample", "checks", "pictures")


MOST_FAILURES = 12
"""Largest number of failed cells in a report."""


def failures(results: Results) -> list[Section]:
    """The section of failed cells, none without failures."""
    if not results.failures:
        return []
    rows = [[f.scene, f.variant, f.probe, f.error] for f in results.failures]
    text = ["These cells are missing from every table. Run the study again to retry them."]
    rest = len(rows) - MOST_FAILURES
    text += [f"{rest} more failed; `attnwarp-eval verify` names them."] * (rest > 0)
    table = Table(["scene", "variant", "probe", "error"], rows[:MOST_FAILURES])
    return [Section("Failed cells", text, [table])]


def meanings(results: Results, timings: bool) -> Section:
    """The folded section on the meaning of all figures, and the seconds of their computation."""
    metrics = {
        metric.name: metric
        for cell in results.cells
        if cell.record
        for view in cell.record.views
        for metric in map(probe(cell.probe).metric, view.metrics)
    }
    rows = [
        [m.name, m.unit, m.direction, str(m.version), m.description]
        for _, m in sorted(metrics.items())
        if not m.is_count
    ]
    text = [
        (
            "Behind a metric's name may stand a region (`interior`, `edge`: within 2 px of a depth"
            " or object edge) or the size of a feature grid. Every value of every view is in"
            " `results.jsonl`."
        ),
    ]
    records = results.all_records()
    text += _environments(records)
    if records and timings:
        total = {
            stage: sum(record.cost.seconds.get(stage) or 0.0 for record in records)
            for stage in STAGES
        }
        peak = max(record.cost.peak_memory_mb for record in records)
        text.append(
            "Seconds over all cells: "
            + ", ".join(f"{stage} {number(seconds)}" for stage, seconds in total.items())
            + f". Peak memory {peak:.0f} MiB."
        )
    table = Table(["metric", "unit", "better", "version", "meaning"], rows, glossary=True)
    return Section("What the figures mean", text, [table], folded=True)


MOST_NOTICES = 6
"""Largest number of notices on scenes in a report; the command that runs a study prints all."""


def measured(results: Results) -> Section:
    """The section on what a run was measured on: cells, scenes, splats, noise, code."""
    study = results.study
    cells = f"Study `{study.name}`: {results.measured} of {len(results.cells)} cells measured"
    text = [f"- {cells}, {len(results.failures)} failed."]
    if study.scenes:
        seeds = f"seed{'s' * (len(study.seeds) > 1)} {', '.join(map(str, study.seeds))}"
        size = f"{study.size} x {study.size} px"
        scenes = study.scenes_in_words
        scenes = scenes[:1].upper() + scenes[1:]
        text.append(f"- {scenes}; {size}; {seeds}. {_means(results)}")
    text += [f"- {line}" for line in _regimes(results)]
    text += [
        f"- One computation, so equal rows of `{name}`: {', '.join(labels)}."
        for name, labels in alike((cell.probe, cell.variants) for cell in results.cells)
    ]
    text += [f"- {line}" for line in _revisions(results.all_records())]
    # Formatted as code: names of files may have asterisks.
    notices = [
        "- **Scene {}**: `{}`".format(scene, line.replace("`", "'"))
        for scene, lines in results.notices.items()
        for line in lines
    ]
    rest = len(notices) - MOST_NOTICES
    text += notices[:MOST_NOTICES] + [f"- {rest} more notices on scenes."] * (rest > 0)
    text += [f"- Columns: {columns}."] if (columns := glossary(results)) else []
    text.append("- Tables of all figures: folded in report.html; `attnwarp-eval report --long`.")
    return Section("What it was measured on", ["\n".join(text)])


def regime(results: Results, table: Table) -> str:
    """Sentences on what a table was measured on, for its caption where it stands alone: scenes,
    splats, noise, editor, encoders, code and test.
    """
    study, records = results.study, results.all_records()
    names = {row[0].strip("`") for row in table.rows} & study.variants.keys()
    scenes = study.scenes_in_words
    seeds = f"seed{'s' * (len(study.seeds) > 1)} {', '.join(map(str, study.seeds))}"
    told = [
        f"Study {study.name}: {scenes}; {study.size} x {study.size} px; {seeds}. {_means(results)}",
        *_regimes(results, names),
        *_digests(records),
        *_revisions(records),
    ]
    if len(study.scenes) >= FEWEST_SCENES:
        told.append(
            "Verdicts: flipped signs of the scenes' differences, paired on scene and view, p-values"
            " adjusted over a table or over the claims (Benjamini and Hochberg)."
        )
    return " ".join(told)


def _digests(records: Sequence[Record[Any]]) -> Iterator[str]:
    """Sentences on the editors and encoders, by the beginning of their SHA-256."""
    editors = {
        f"SHA-256 {one['sha256'][:12]}"
        if "sha256" in one
        else " and ".join(
            f"the {kind} editor ({', '.join(f'{k} {v}' for k, v in settings.items())})"
            for kind, settings in one.items()
        )
        for record in records
        if (one := record.spec.get("editor"))
    }
    encoders = {
        f"{kind} {one['weights_sha256'][:12]}"
        for record in records
        for kind, one in (record.spec.get("encoders") or {}).items()
        if one
    }
    for word, found in (("Editor", editors), ("Encoder", encoders)):
        if found:
            yield f"{word}{'s' * (len(found) > 1)}: {', '.join(sorted(found))}."


def _means(results: Results) -> str:
    count = len(results.study.scenes)
    if count == 1:
        return (
            "Figures are means over the views of one scene, which has no interval. **One scene says"
            " nothing of others. Name six scenes or more for a verdict.**"
        )
    text = f"Figures are means over {count} scenes of means over their views"
    if count < FEWEST_SCENES:
        return f"{text}; brackets hold the lowest and the highest scene. So few give no verdict."
    return f"{text}, ± half of the 95 % interval (Student's t over scenes)."


def _regimes(results: Results, among: Collection[str] = ()) -> Iterator[str]:
    """Sentences on the splats and on the noise of edited views, by the variants of each.

    Args:
        among: variants that are told of; all if empty.
    """
    splats: dict[str, list[str]] = {}
    noise: dict[str, list[str]] = {}
    for cell in results.cells:
        variants = [name for name in cell.variants if not among or name in among]
        if cell.record is None or not variants:
            continue
        spec = cell.record.spec
        if is_fitted(spec):
            splats.setdefault("fitted to true pictures", []).extend(variants)
        elif "splats" in spec:
            splats.setdefault("sampled on the true surfaces", []).extend(variants)
        if probe(cell.probe).edits and "noise" in spec.get("settings", {}):
            kind = NOISE.get(spec["settings"]["noise"], spec["settings"]["noise"])
            noise.setdefault(kind, []).extend(variants)
    for title, kinds in (("Splats", splats), ("Noise of edited views", noise)):
        named = {kind: dict.fromkeys(names) for kind, names in kinds.items()}
        most = max(named, key=lambda kind: len(named[kind]), default="")
        rest = [f"{kind} in {', '.join(n)}" for kind, n in named.items() if kind != most]
        if named:
            yield f"{title}: {'; '.join([most, *rest])}."


def _revisions(records: Sequence[Record[Any]]) -> Iterator[str]:
    """A sentence on the code that computed the cells."""
    counted = Counter(
        (record.environment.revision[:12] if record.environment.revision else "an installed copy")
        + " with local changes" * bool(record.environment.dirty)
        for record in records
    )
    if counted:
        several = len(counted) > 1
        told = (f"`{code}`" + f" ({count} cells)" * several for code, count in counted.items())
        yield f"Revision{'s' * several}: {', '.join(told)}."


def _environments(records: Sequence[Record[Any]]) -> list[str]:
    """Every state of code, versions and machine that computed cells of this run, with the number of
    cells.
    """
    counted: dict[str, int] = {}
    states = {(record.environment.revision, record.environment.source) for record in records}
    for record in records:
        environment = record.environment
        revision = environment.revision
        code = f"revision `{revision[:12]}`" if revision else "an installed copy"
        if environment.dirty:
            code += " with local changes"
        # One revision has several source hashes if plugins changed.
        several = sum(other == revision for other, _ in states) > 1
        if environment.source and (environment.dirty or not revision or several):
            code += f" (source `{environment.source[:12]}`)"
        versions = ", ".join(f"{name} {version}" for name, version in environment.versions.items())
        machine = environment.machine
        computer = f"{machine['system']} {machine['arch']}, {machine['cores']} cores"
        described = f"{code}; {versions}; {computer}"
        counted[described] = counted.get(described, 0) + 1
    if len(counted) < 2:
        return [f"Computed with {described}." for described in counted]
    lines = [
        f"{count} cell{'s' if count > 1 else ''} with {described}"
        for described, count in sorted(counted.items(), key=lambda x: -x[1])
    ]
    return [
        "**The cells of this run were computed with more than one state of code or machine:** "
        + "; ".join(lines)
        + "."
    ]
