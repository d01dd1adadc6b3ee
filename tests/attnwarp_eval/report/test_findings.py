"""Beginning of a page. Oracle: hand-made records whose differences follow by hand."""

import inspect
import re

import pytest
import written_runs

from attnwarp_eval.document.model import Slider
from attnwarp_eval.report.ablations import compared_of
from attnwarp_eval.report.claims import load_claims
from attnwarp_eval.report.findings import findings
from attnwarp_eval.report.judging import judge
from attnwarp_eval.study import pictures
from attnwarp_eval.study.edit_truth import Judgement
from attnwarp_eval.study.probes.editing.result import EditResult, Measurement
from attnwarp_eval.study.record import PictureFile

SCENES = ("one", "two", "three")
SLIP = "warp.epe_median_layer.64"
DONE = Judgement("red", True, 25.0, 10.0, 10.0)
EDIT = EditResult("colour=red", "make it red", DONE, DONE, {}, {}, 25.0, 2, 1.0)


def found(run, problems, **options):
    judged = judge(run, load_claims())
    return findings(run, problems, judged, compared_of(run, judged), **options)


def results(variants, values, *, pictures=True, calibration=None):
    study = {
        "name": "hand-made",
        "scenes": list(SCENES),
        "variants": variants,
        "probes": {"warp": list(variants)},
        "ablations": [{"title": "Slip", "baseline": "good", "variants": ["slipped"]}],
    }
    cells = []
    for name in variants:
        for i, scene in enumerate(SCENES):
            views = [(f"v{j}", 0.0, {SLIP: v}) for j, v in enumerate(values[name][i])]
            cell = written_runs.outcome("warp", scene, [name], written_runs.record(views))
            if pictures:
                cell.record.__dict__["pictures"] = tuple(
                    PictureFile(view, "endpoint-error", f"{name}-{scene}-{view}.jpg", "")
                    for view, *_ in views
                )
            cells.append(cell)
    if calibration is not None:
        data = written_runs.record([("v0", 0.0, {"warp.epe_median": calibration})])
        cells.append(written_runs.outcome("calibration", "one", ["calibration"], data))
    return written_runs.results(study, cells)


CLAIMED = {"good": {}, "slipped": {"set": {"pixel_centers": "integer"}}}
OTHER = {"good": {}, "slipped": {"set": {"depth_agreement": False}}}
# Geometric means of the ratios: 6, sqrt(4.8 * 7) and sqrt(7 * 5.2).
VALUES = {
    "good": [[0.1, 0.1], [0.1, 0.1], [0.1, 0.1]],
    "slipped": [[0.6, 0.6], [0.48, 0.7], [0.7, 0.52]],
}


def test_a_claim_comes_with_its_difference_and_the_view_in_which_it_is_largest():
    (finding,) = found(results(CLAIMED, VALUES), [])
    assert finding.text.startswith("Integer pixel centres")
    assert finding.text.endswith("seen here.")
    assert finding.value == "× 5.94 (5.80 to 6.03)"
    assert finding.outcome == "holds"
    assert isinstance(finding.picture, Slider)
    # 0.7 - 0.1; view 1 of scene two has the same, and a later name.
    assert finding.picture.after.path == "slipped-three-v0.jpg"
    assert finding.picture.before.path == "good-three-v0.jpg"


def test_a_claim_that_some_scenes_lack_says_in_how_many_it_is_seen():
    values = {**VALUES, "slipped": [*VALUES["slipped"][:2], [None, None]]}
    (finding,) = found(results(CLAIMED, values), [])
    assert finding.text.endswith("seen here in 2 of 3 scenes.")
    assert finding.outcome == "holds"


def test_a_difference_that_no_claim_names_is_told_once_with_its_verdict():
    (finding,) = found(results(OTHER, VALUES), [])
    assert finding.text.startswith("Slip: `slipped` is worse than `good` (")
    assert (finding.value, finding.outcome) == ("× 5.94 (5.80 to 6.03)", "fails")
    (bare,) = found(results(OTHER, VALUES), [], pictures=False)
    assert bare.picture is None


def test_what_cannot_be_told_is_no_finding():
    mixed = {"good": VALUES["good"], "slipped": [[0.2, 0.1], [0.1, 0.0], [0.1, 0.1]]}
    assert found(results(OTHER, mixed), []) == []


@pytest.mark.parametrize("problems", [[], ["one: warp.epe_median is 3, expected below 0.001 px"]])
def test_the_instrument_comes_first(problems):
    first, _ = found(results(CLAIMED, VALUES, calibration=3.0), problems)
    assert ("not calibrated" in first.text) == bool(problems)
    assert first.value == "3.0 px"
    assert first.outcome == ("fails" if problems else "holds")


@pytest.mark.parametrize("pictured", [("alone", "propagated"), ("propagated",)])
def test_an_edit_is_shown_beside_its_counterpart_or_else_beside_the_unedited_view(pictured):
    names, metric = ("alone", "propagated"), "fidelity.psnr.edit_inside"
    study = {
        "name": "edits",
        "scenes": list(SCENES),
        "variants": {name: {} for name in names},
        "probes": {"editing": list(names)},
        "ablations": [
            {"title": "Help", "probe": "editing", "baseline": names[0], "variants": [names[1]]}
        ],
    }
    cells = []
    for scene, gain in zip(SCENES, (5.1, 5.0, 4.9), strict=True):
        for name, value in zip(names, (20.0, 20.0 + gain), strict=True):
            values = {"red/far": 20.0, "red/near": value}
            data = written_runs.record([(v, 0.0, {metric: x}) for v, x in values.items()])
            data |= EDIT.to_json()
            cell = written_runs.outcome("editing", scene, [name], data)
            cell.record.__dict__["pictures"] = tuple(
                PictureFile(view, content, f"{name}-{scene}-{view}-{content}.jpg", "")
                for view in values
                for content in ("before", "edited")
                if name in pictured
            )
            cells.append(cell)
    (finding,) = found(written_runs.results(study, cells), [])
    assert finding.picture.after.path == ("propagated-one-red/near-edited.jpg")
    assert finding.picture.before.path == (
        "alone-one-red/near-edited.jpg"
        if len(pictured) == 2
        else "propagated-one-red/near-before.jpg"
    )


def test_every_content_that_a_finding_looks_for_is_one_that_a_picture_has():
    from attnwarp_eval.report.findings import CONTENTS

    # The keys of the dictionaries of pictures, and of nothing else in their modules.
    drawing = (pictures.of_warp, pictures.of_depth, pictures.of_fit, Measurement._draw)
    drawn = set(re.findall(r'"([a-z-]+)":', "".join(map(inspect.getsource, drawing))))
    assert {content for contents in CONTENTS.values() for content in contents} <= drawn
