"""Tables of a study with several edits. Oracle: differences planted by edit."""

import written_runs

from attnwarp_eval.report.ablations import compared_of, differences

SCENES = [f"s{k}" for k in range(8)]
RIGHT = {("one", "a"): 0.5, ("one", "b"): 0.7, ("several", "a"): 0.6, ("several", "b"): 0.4}


def planted():
    study = {
        "name": "edits", "size": 64, "scenes": SCENES, "variants": {"a": {}, "b": {}},
        "probes": {"labels": ["a", "b"]},
        "ablations": [{"title": "b", "probe": "labels", "baseline": "a", "variants": ["b"]}],
    }  # fmt: skip
    cells = []
    for number, scene in enumerate(SCENES):
        for (edit, variant), right in RIGHT.items():
            views = [(f"{edit}/yaw030", 30.0, {"labels.net": right + 0.01 * number})]
            data = written_runs.record(views, spec={"edit": {"name": edit}})
            name = f"{scene}-{edit}-{variant}"
            cells.append(written_runs.outcome("labels", scene, [variant], data, name))
    return written_runs.results(study, cells)


def test_edits_of_opposite_signs_are_not_pooled():
    results = planted()
    compared = compared_of(results, [])
    told = [[one.word for one in rows if one.metric == "labels.net"] for rows in compared]
    assert told == [["better"], ["worse"]]
    (section,) = differences(results, compared)
    assert [table.caption for table in section.tables] == ["b: one", "b: several"]
    assert [table.rows[0][1].split()[0] for table in section.tables] == ["0.535", "0.635"]
