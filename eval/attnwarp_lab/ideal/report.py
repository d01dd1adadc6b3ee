"""Report of edits by the ideal editor: parts that its probes share."""

from __future__ import annotations

from attnwarp_eval.study.probe_report import ProbeReport
from attnwarp_eval.study.results import Results


class EditorReport(ProbeReport):
    """Cost of edits by the ideal editor, and editors that are not ideal, for reports."""

    cost = "whole"
    cost_of = "an edit"
    cost_text = "Seconds are those of one whole edit of a scene by the ideal editor, with tuning."

    def problems(self, results: Results) -> list[str]:
        """Editors that are not ideal: they have favourite answers, or agree without features."""
        variants: dict[tuple[str, str], list[str]] = {}
        for cell, record in results.finished(self.name):
            if record.extra.fault is not None:
                variants.setdefault((cell.scene, record.extra.fault), []).extend(cell.variants)
        return [
            f"{scene}: not ideal in {', '.join(names)}: {fault}"
            for (scene, fault), names in sorted(variants.items())
        ]
