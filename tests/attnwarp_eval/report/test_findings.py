"""What a page begins with. Oracle: hand-made records whose differences follow by hand."""

import pathlib
import re

import pytest
import written_runs

from attnwarp_eval.document.model import Slider
from attnwarp_eval.report.findings import findings
from attnwarp_eval.study.record import PictureFile

SCENES = ("one", "two", "three")
SLIP = "warp.epe_median_layer.64"


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
VALUES = {
    "good": [[0.1, 0.1], [0.1, 0.1], [0.1, 0.1]],
    "slipped": [[0.6, 0.6], [0.5, 0.7], [0.7, 0.5]],
}


def test_a_claim_comes_with_its_difference_and_the_view_in_which_it_is_largest():
    (finding,) = findings(results(CLAIMED, VALUES), [])
    assert finding.text.startswith("Integer pixel centres")
    assert finding.text.endswith("seen here, holds in general.")
    assert finding.value == "+0.500 ± 0 layer px"
    assert finding.outcome == "holds"
    assert isinstance(finding.picture, Slider)
    # 0.7 - 0.1; view 1 of scene two has the same, and a later name.
    assert finding.picture.after.path == "slipped-three-v0.jpg"
    assert finding.picture.before.path == "good-three-v0.jpg"


def test_a_difference_that_no_claim_names_is_told_once_with_its_verdict():
    (finding,) = findings(results(OTHER, VALUES), [])
    assert finding.text.startswith("Slip: `slipped` is worse than `good` (")
    assert (finding.value, finding.outcome) == ("+0.500 ± 0 layer px", "fails")
    (bare,) = findings(results(OTHER, VALUES), [], pictures=False)
    assert bare.picture is None


def test_what_cannot_be_told_is_no_finding():
    mixed = {"good": VALUES["good"], "slipped": [[0.2, 0.1], [0.1, 0.0], [0.1, 0.1]]}
    assert findings(results(OTHER, mixed), []) == []


@pytest.mark.parametrize("problems", [[], ["one: warp.epe_median is 3, expected below 0.001 px"]])
def test_the_instrument_comes_first(problems):
    first, _ = findings(results(CLAIMED, VALUES, calibration=3.0), problems)
    assert ("not calibrated" in first.text) == bool(problems)
    assert first.value == "3.0 px"
    assert first.outcome == ("fails" if problems else "holds")


def test_every_content_that_a_finding_looks_for_is_one_that_a_picture_has():
    from attnwarp_eval.report.findings import CONTENTS

    source = pathlib.Path(findings.__code__.co_filename).parents[1] / "study" / "pictures.py"
    drawn = set(re.findall(r'"([a-z-]+)":', source.read_text()))
    assert {content for contents in CONTENTS.values() for content in contents} <= drawn
