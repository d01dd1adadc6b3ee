"""Sentences of the report where nothing was drawn."""

import written_runs

from attnwarp_eval.document.write import markdown
from attnwarp_eval.report.build import build

STUDY = {
    "name": "hand-made",
    "scenes": ["bead", "house"],
    "variants": {"near": {}, "far": {"set": {"depth": "center"}}},
    "probes": {"depth": ["near", "far"]},
}


def report(root, coverage):
    """A run of depth, by scene and variant the coverage of its views "a" and "b"."""
    cells = []
    for (scene, variant), values in coverage.items():
        views = [
            (name, 30.0, {"depth.coverage": value, "depth.abs_rel": 0.1 if value else None})
            for name, value in zip("ab", values, strict=True)
        ]
        data = written_runs.record(views)
        cells.append(written_runs.outcome("depth", scene, [variant], data, f"{scene}-{variant}"))
    return build(written_runs.results(STUDY, cells), root, timings=False)


def test_views_in_which_no_splat_is_drawn_are_named(tmp_path):
    made = report(
        tmp_path,
        {
            ("bead", "near"): (0.0, 0.0),
            ("bead", "far"): (0.5, 0.0),
            ("house", "near"): (1.0, None),  # None: no surface either
            ("house", "far"): (1.0, 1e-3),
        },
    )
    sentence = (
        "No splat is drawn on any surface, so depth is undefined, in bead / near (every view);"
        " bead / far (b)."
    )
    assert f"{sentence} That is 3 of 8 views." in markdown(made)


def test_nothing_is_said_where_every_view_has_a_depth(tmp_path):
    made = report(tmp_path, {("house", "near"): (1.0, 0.9), ("house", "far"): (1.0, 0.01)})
    assert "Views without depth" not in markdown(made)
