"""Oracle: figures written by hand, which a control moves or does not."""

import itertools
import re

import numpy as np
import pytest
import written_runs

from attnwarp_eval.document.write import markdown
from attnwarp_eval.report.build import build
from attnwarp_eval.report.controls import control_share, share_text

SCENES = [f"scene{k}" for k in range(8)]
STUDY = {
    "name": "hand-made",
    "scenes": SCENES,
    "editing": {"editor": {"ideal": {}}},
    "variants": {"full": {}, "half": {"options": {"a0": 0.5}}, "mirrored": {"control": "mirrored"}},
    "probes": {"ideal": ["full", "half", "mirrored"]},
    "ablations": [{"title": "Weights", "probe": "ideal", "baseline": "full", "variants": ["half"]}],
}
IDEAL = {
    "share": 1.0, "settled": 0.4, "frequencies": [0.5, 0.5], "agreement": 0.5, "fault": None,
    "part_share": 0.01, "answers": [0], "edited": 2,
}  # fmt: skip
SPEC = {
    "editor": {"ideal": {"parts": 12, "colors": 2, "settled": 0.4, "cross": "paint"}},
    "settings": {"steps": 8},
}


def report(folder, mirrored, study=STUDY):
    """A run in which half the weight moves nothing that can be told; ``mirrored`` is the control's own figure."""
    cells = []
    for k, scene in enumerate(SCENES):
        wobble = 0.01 * (-1) ** k
        figures = {
            "full": 0.8 + 0.002 * k,
            "half": 0.8 + 0.002 * k + wobble,
            "mirrored": mirrored + 0.003 * k,
        }
        for name in study["variants"]:
            views = [("parts/a", 30.0, {"parts.seen.edit": figures[name]})]
            data = written_runs.record(views, spec=SPEC, ideal=IDEAL)
            cells.append(written_runs.outcome("ideal", scene, [name], data, f"{scene}-{name}"))
    return markdown(build(written_runs.results(study, cells), folder, timings=False))


def row(text):
    return next(line for line in text.splitlines() if line.startswith("| half | parts.seen.edit"))


def test_a_figure_that_no_control_moves_is_blind(tmp_path):
    text = report(tmp_path, 0.8)
    assert "| blind |" in row(text) and "can't tell" not in row(text)
    assert re.search(r"\| half \| 0.8\d* ± [\d.]+ blind \|", text)


def test_a_figure_that_a_control_moves_cannot_tell(tmp_path):
    text = report(tmp_path, 0.3)
    assert "| can't tell |" in row(text)


def test_a_control_that_does_better_is_no_control(tmp_path):
    assert "| blind |" in row(report(tmp_path, 0.95))


def test_a_section_says_what_each_figure_sees(tmp_path):
    for mirrored, word, answer in ((0.3, "seen", "sees"), (0.8, "not seen", "blind")):
        text = report(tmp_path, mirrored).partition("## Controls")[2]
        rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
        first = {row[0].strip("| "): row[1:3] for row in rows}
        assert first["mirrored"] == ["seen", word]
        assert first["this figure is"][1] == answer


def test_without_controls_nothing_is_blind(tmp_path):
    variants = {name: STUDY["variants"][name] for name in ("full", "half")}
    study = {**STUDY, "variants": variants, "probes": {"ideal": ["full", "half"]}}
    assert "| can't tell |" in row(report(tmp_path, 0.8, study))


@pytest.mark.parametrize("weakest", [-0.2, -0.5])
def test_a_draw_without_a_gain_bounds_the_share_of_a_control_on_neither_side(weakest):
    """Oracle: all 46,656 draws of six scenes. Of those without a gain, no share of it is known."""
    gains = np.array([1.0, 0.9, 0.3, 0.2, 0.1, weakest])
    reached = np.array([0.3, 0.1, 0.2, 0.1, -0.1, 0.1])
    tables = [
        {f"s{k}": {"v": value} for k, value in enumerate(side)}
        for side in (gains, reached, np.zeros(6))
    ]
    drawn = np.array(list(itertools.product(range(6), repeat=6)))
    gain, part = gains[drawn].sum(axis=1), reached[drawn].sum(axis=1)
    mean, low, high = control_share(*tables)
    lost = (gain <= 0).mean()
    assert mean == pytest.approx(reached.sum() / gains.sum())
    if lost >= 0.025:
        assert (low, high) == (-np.inf, np.inf)
        assert share_text((mean, low, high)).endswith(" % (no bounds)")
        return
    known = part[gain > 0] / gain[gain > 0]
    # Of 1,000 draws, 25 lie beyond an end; three standard errors are 15.
    for beyond in ((known < low).sum(), (known > high).sum()):
        assert (beyond / len(drawn) + lost) == pytest.approx(0.025, abs=0.015)
