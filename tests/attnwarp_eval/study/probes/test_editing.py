"""Oracles: methods that give the true pictures of planned answers, whose figures follow from the plan; exact masks."""

import dataclasses
import hashlib
import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from ball_scene import SCENE
from edited_run import write_run
from PIL import Image
from torch_threads import on_one_thread

import attnwarp_eval
from attnwarp_eval import metrics
from attnwarp_eval.encoders.dino_small import WEIGHTS
from attnwarp_eval.metrics.gates import gated
from attnwarp_eval.metrics.registry import METRICS
from attnwarp_eval.report import write_report
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, StudyError, cells_of, load_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.run import execute, plan
from attnwarp_eval.study.shared import edit_figures, edits
from attnwarp_eval.study.shared.edit_truth import edit_truth
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, EditedScene, Method
from attnwarp_eval.study.work import compute
from attnwarp_eval.truth import Geometry, two_view
from attnwarp_eval.world import world

STUDY = {
    "name": "mine",
    "size": 32,
    "scenes": ["ball.yaml"],
    "spp": 4,
    "splats": {"count": 300},
    "editing": {"options": {"views_per_stage": 2, "stages": 2, "iterations": 1}},
    "variants": {"planned": {"method": "true pictures"}},
    "probes": {"editing": ["planned"]},
}  # fmt: skip
ROUNDING = 0.5 / 255
"""Half a step of 8 bits, which edited views are rounded to."""


def load(folder, **changes):
    (folder / "mine.yaml").write_text(yaml.safe_dump({**STUDY, **changes}))
    return load_study(str(folder / "mine.yaml"))


def record_of(folder, tmp_path, **changes):
    study = load(folder, **changes)
    scenes = {name: load_scene(name) for name in study.scenes}
    cell = next(c for c in cells_of(study, scenes) if c.probe == "editing")
    return compute(probe("editing"), cell, tmp_path)


def figure(record, name):
    return [view.metrics[name] for view in record.views]


def planned(answers):
    """A method that shows these answers, view by view; the unedited picture for None."""

    def run(job):
        pictures = [
            job.images[view] if answer is None else job.truth[answer][view]
            for view, answer in enumerate(answers)
        ]
        edited = {
            view: np.rint(255 * image).astype(np.uint8) for view, image in enumerate(pictures)
        }
        return EditedScene(job.gaussians, edited, {"edit": 1.0}, {"views": len(edited)})

    return Method(EDITING_METHODS["attention_warping"].settings, run)


def test_true_pictures_have_the_highest_fidelity_the_least_disagreement_and_one_answer(
    folder, tmp_path
):
    record = record_of(folder, tmp_path)
    assert record.extra.source.answer == "red"
    assert record.extra.source.done
    assert figure(record, "multiview.same_answer.edit") == [1, 1, 1]
    assert max(figure(record, "fidelity.mse.edit")) <= ROUNDING**2
    decibels = [name for name in record.views[0].metrics if "psnr" in name]
    assert {name.split(".")[1] for name in decibels} == {"psnr", "preserved_psnr"}
    for name in decibels:
        errors = np.array(figure(record, name.replace("psnr", "mse")))
        with np.errstate(divide="ignore"):
            np.testing.assert_allclose(figure(record, name), -10 * np.log10(errors))
    # Rounding by half a step moves a mean CIEDE2000 of these colours by less than 0.3.
    above = [v for v in figure(record, "multiview.delta_e_above.edit_inside") if not math.isnan(v)]
    assert above
    assert max(map(abs, above)) < 0.3
    # One iteration of tuning leaves the render grey, so it follows no edit.
    assert max(figure(record, "fidelity.psnr.render_inside")) < 30
    assert figure(record, "depth.abs_rel.before") == pytest.approx(
        figure(record, "depth.abs_rel.after"), rel=0.2
    )
    # Without encoders; docs/measuring/gate.md.
    assert {METRICS[key].name for key in record.views[0].metrics if gated(key)} == {
        "multiview.delta_e", "multiview.delta_e_above", "multiview.same_answer", "fidelity.mse",
        "fidelity.ssim", "fidelity.preserved_mse", "fidelity.preserved_psnr", "image.mse", "image.psnr",
        "depth.abs_rel",
    }  # fmt: skip


def test_an_answer_for_each_view_is_seen_as_it_was_planned(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(
        EDITING_METHODS, "true pictures", planned(["green", "red", "green", "blue"])
    )
    record = record_of(folder, tmp_path)
    assert record.extra.answers["edit"] == {
        "source": "green", "yaw015": "red", "yaw030": "green", "yaw120": "blue",
    }  # fmt: skip
    # Answers drawn at random agree with the source's in one of three views, as here.
    assert figure(record, "multiview.same_answer.edit") == [0, 1, 0]
    above = figure(record, "multiview.delta_e_above.edit_inside")
    assert above[0] > 20  # red beside green
    assert abs(above[1]) < 0.3
    # No view has another neighbour of its own answer but none here: red-green, green-red, blue-green.
    assert min(v for v in figure(record, "multiview.delta_e_above.edit_next") if v == v) > 20


def test_the_documents_method_edits_each_view_as_the_control_does(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(EDITING_METHODS, "mine", planned([]))  # taken back afterwards
    text = (Path(attnwarp_eval.__file__).parents[2] / "docs/project/extending.md").read_text()
    exec(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1], {})

    def pictures(**variant):
        record = record_of(folder, tmp_path, variants={"one": variant}, probes={"editing": ["one"]})
        return figure(record, "fidelity.mse.edit")

    control = pictures(options={"a0": 0.0})
    assert pictures(method="mine") == pytest.approx(control, rel=1e-3)
    monkeypatch.setitem(EDITING_METHODS, "mine", planned([]))
    with pytest.raises(StudyError, match="^method 'mine' gave no edited view"):
        pictures(method="mine")


@pytest.mark.parametrize("more", [0, 1])
def test_agreement_over_fewer_pixels_than_a_cell_of_the_latents_is_undefined(
    folder, tmp_path, monkeypatch, more
):
    monkeypatch.setitem(EDITING_METHODS, "true pictures", planned(["red"] * 4))
    scene = load(folder).scenes[0]
    of = world(scene, STUDY["size"])
    mask = edit_truth(
        scene, STUDY["size"], STUDY["spp"], "some_colour", (of.source.name, "yaw030")
    ).masks["red"]["yaw030"]
    black = np.zeros((*mask.shape, 3))
    pair = of.between(of.source.name, "yaw030")
    count = metrics.cross_view(black, black, pair, mask=mask).counted.sum()
    monkeypatch.setattr(edit_figures, "LEAST_PIXELS", count + more)
    record = record_of(folder, tmp_path)
    view = next(v for v in record.views if v.name.endswith("yaw030"))
    for key in ("delta_e", "delta_e_floor", "delta_e_above"):
        assert math.isnan(view.metrics[f"multiview.{key}.edit_inside"]) == bool(more)


def test_where_the_source_is_not_edited_agreement_is_undefined_and_the_report_names_the_edit(
    folder, tmp_path, monkeypatch
):
    monkeypatch.setitem(EDITING_METHODS, "true pictures", planned([None, "red", "red", "red"]))
    study = load(folder, encoders={"dino": "dino-small"})
    store = Store(tmp_path / "run")
    summary = execute(plan(study, store), store)
    assert summary.complete, summary.failures
    cell = next(c for c in plan(study, store).cells if c.probe == "editing")
    record = store.read_as(cell.id, probe("editing").read)
    assert not record.extra.source.done
    for name in ("multiview.same_answer.edit", "multiview.delta_e_above.edit_inside"):
        assert all(map(math.isnan, figure(record, name)))
    write_report(store, timings=False, long=True)
    report = (store.root / "report.md").read_text()
    row = next(line for line in report.splitlines() if "Paint the ball" in line)
    assert "some_colour" in row
    assert "**no**" in row
    weights = hashlib.sha256((WEIGHTS / "dino-small.safetensors").read_bytes()).hexdigest()
    assert f"Encoders: dino `dino-small` ({weights[:12]})." in report


def test_each_method_stands_beside_its_own_edit_of_the_source(tmp_path):
    red, green, white = (220, 30, 30), (30, 220, 30), (250, 250, 250)
    sources = {"alone": red, "warped": green, "third": red}
    made = {
        name: {"source-edit": color, "edited": white, "truth": color}
        for name, color in sources.items()
    }
    store = Store(write_run(tmp_path, views=1, seeds=(0,), more=made).root)
    write_report(store, long=True)
    section = (store.root / "report.md").read_text().split("## Edited views side by side")[1]
    for edit in ("red", "blue"):
        row = re.findall(rf"!\[([^]]*)\]\((pictures/[^)]*/{edit}/[^)]*)\)", section)
        pictures = [
            (caption, Image.open(store.root / path).getpixel((0, 0))) for caption, path in row
        ]
        source, view = "source's edit", "15°"
        methods = [(name, head) for name in sources for head in (source, view)]
        truths = ["truth: alone, third", "truth: warped"]
        assert [caption for caption, _ in pictures] == [
            f"{label}, {head}"
            for label, head in [("before", view), *methods, *((one, view) for one in truths)]
        ]
        # JPEG moves a plain colour by a few steps.
        expected = [(128, 128, 128), red, white, green, white, red, white, red, green]
        for (caption, color), planned_color in zip(pictures, expected, strict=True):
            assert color == pytest.approx(planned_color, abs=4), caption


def test_seconds_are_in_the_record_and_not_in_the_report_without_timings(
    folder, tmp_path, monkeypatch
):
    reports = []
    for seconds in (1.0, 77.0):
        method = planned(["red"] * 4)
        slow = dataclasses.replace(
            method, run=lambda job, m=method, s=seconds: dataclasses.replace(m.run(job), seconds={"edit": s})
        )  # fmt: skip
        monkeypatch.setitem(EDITING_METHODS, "true pictures", slow)
        study, store = load(folder), Store(tmp_path / str(seconds))
        assert execute(plan(study, store), store).complete
        records = [store.read(cell.id) for cell in plan(study, store).cells]
        assert [r["cost"]["seconds"].get("whole") for r in records] == [None, seconds]
        write_report(store, timings=False)
        reports.append([(store.root / n).read_bytes() for n in ("report.md", "results.jsonl")])
    assert reports[0] == reports[1]


def test_the_exact_mask_injects_where_the_source_truly_sees(folder, tmp_path):
    options = {"stages": 1, "views_per_stage": 3, "steps": 1, "iterations": 1}
    own = {"options": options, "mask": "truth", "geometry": "truth"}
    record = record_of(folder, tmp_path, editing={}, variants={"planned": own})
    scene = load_scene(load_study(str(folder / "mine.yaml")).scenes[0]).with_size(32, 32)
    geometry, targets = Geometry(scene), {camera.name: camera for camera in scene.targets}
    seen = [
        two_view(geometry, scene.source, targets[view.name.split("/")[1]]).visible.mean()
        for view in record.views
    ]
    assert record.extra.injected == pytest.approx(np.mean(seen), abs=1e-6)
    assert (
        record.cost.counters["network_rows"] == 4 * 2
    )  # one step; image guidance of 1 drops a branch


def test_each_source_has_its_own_exact_warp_to_a_target(folder, tmp_path, monkeypatch):
    asked = {}

    def run(job):
        asked.update({pair: job.warps(*pair) for pair in ((0, 3), (2, 3), (1, 3))})
        return planned(["red"] * 4).run(job)

    method = Method(EDITING_METHODS["attention_warping"].settings, run)
    monkeypatch.setitem(EDITING_METHODS, "planned", method)
    own = {"method": "planned", "mask": "truth", "geometry": "truth"}
    record_of(folder, tmp_path, variants={"planned": own})
    scene = load_scene(load_study(str(folder / "mine.yaml")).scenes[0]).with_size(32, 32)
    cameras = [scene.source, *scene.targets]
    seen = {}
    for (source, target), warp in asked.items():
        exact = two_view(Geometry(scene), cameras[source], cameras[target])
        assert (warp.mask.numpy() == exact.visible).all()
        seen[source] = warp.correspondence.xy.numpy()[exact.visible]
        assert seen[source] == pytest.approx(exact.xy[exact.visible], abs=1e-3)
    assert len({len(pixels) for pixels in seen.values()}) > 1


def test_a_compared_method_edits_every_view_with_its_own_settings(folder, tmp_path):
    own = {"method": "by_view", "options": {"steps": 2, "iterations": 3}}
    record = record_of(folder, tmp_path, editing={}, variants={"planned": own})
    counters = record.cost.counters
    # Four views, two steps; image guidance of 1 drops a branch.
    assert counters["network_rows"] == 4 * 2 * 2
    assert (counters["edits"], counters["iterations"], record.extra.edited) == (4, 3, 4)


def test_the_study_that_compares_methods_tunes_attention_warping_alike():
    """Oracle: stages counted by hand."""
    study = load_study("comparison")
    totals = {}
    for label in study.probes["editing"]:
        variant = study.variants[label]
        fields = edits.settings_of(study, variant, 0)
        if variant.part(edits.VariantPart).method == "attention_warping" and fields["a0"] > 0:
            stages = min(fields["stages"], math.ceil(len(study.views) / fields["views_per_stage"]))
            totals[label] = stages * fields["iterations"]
    assert len(totals) >= 2
    assert len(set(totals.values())) == 1, totals


def test_an_editor_of_depth_maps_gets_the_description_and_others_the_instruction(
    folder, tmp_path, monkeypatch
):
    words = []

    def run(job):
        words.append((job.editor.guide, job.instruction))
        return planned(["red"] * 4).run(job)

    monkeypatch.setitem(
        EDITING_METHODS, "planned", Method(EDITING_METHODS["attention_warping"].settings, run)
    )
    for name in ("small-depth", "small-plain"):
        own = {"method": "planned", "editor": {"name": name, "text_guidance": 1.5}}
        record_of(folder, tmp_path, variants={"planned": own})
    (edit,) = SCENE["edits"]
    assert words == [("depth", edit["target"]), ("picture", edit["instruction"])]


def test_an_editor_without_its_draw_edits_in_a_cell_of_its_own(folder, tmp_path, monkeypatch):
    nets = []

    def run(job):
        nets.append(job.editor.unet.draw)
        return planned(["red"] * 4).run(job)

    monkeypatch.setitem(
        EDITING_METHODS, "planned", Method(EDITING_METHODS["attention_warping"].settings, run)
    )
    ids = {
        record_of(
            folder,
            tmp_path,
            variants={"planned": {"method": "planned", "editor": {"draws": draws}}},
        ).id
        for draws in (True, False)
    }
    assert len(ids) == 2
    assert nets[0] is not None
    assert nets[1] is None


def test_an_editor_that_has_no_draw_is_refused_when_its_study_is_read():
    with pytest.raises(StudyError, match="draws: 'small-depth' has no draw"):
        edits.editor_identity(edits.EditorPart(name="small-depth", draws=False))


@pytest.mark.parametrize("method", ["gaussctrl", "attention_warping"])
def test_the_scenes_words_are_handed_to_an_inversion_that_asks_for_them(
    method, folder, tmp_path, monkeypatch
):
    prompts = []

    def run(job):
        prompts.append(job.settings.get("source_prompt"))
        return planned(["red"] * 4).run(job)

    monkeypatch.setitem(
        EDITING_METHODS, method, dataclasses.replace(EDITING_METHODS[method], run=run)
    )
    options = {"latents": "inversion", "source_prompt": "{source}, photographed"}
    own = {"method": method, "editor": {"name": "small-depth"}, "options": options}
    record = record_of(folder, tmp_path, editing={}, variants={"planned": own})
    (edit,) = SCENE["edits"]
    assert prompts == [f"{edit['source']}, photographed"]
    # The words are the edit's, which the cell has beside them.
    assert record.spec["settings"]["source_prompt"] == options["source_prompt"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variants": {"planned": {"method": "dge", "options": {"stages": 2}}}}, "stages"),
        ({"editing": {"edits": {"ball": {"some_colour=gold": None}}}}, "no answer 'gold'"),
        (
            {"editing": {"editor": {"name": "no-such"}}, "variants": {"planned": {}}},
            "editor 'no-such'",
        ),
    ],
)
def test_what_cannot_be_measured_is_refused_by_its_key(folder, changes, message):
    with pytest.raises(StudyError, match=message):
        study = load(folder, **changes)
        cells_of(study, {name: load_scene(name) for name in study.scenes})


def test_an_editor_is_known_by_its_files_wherever_its_controlnet_lies(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    for base, control in ((one, one / "controlnet"), (other, tmp_path / "depth")):
        for folder, text in ((base / "unet", "{}"), (control, '{"a": 1}')):
            folder.mkdir(parents=True)
            (folder / "config.json").write_text(text)
    (other / "controlnet").mkdir()  # not the one that is named
    (other / "controlnet" / "config.json").write_text("{}")

    def identity(name):
        return edits.editor_identity(edits.EditorPart(name=name))

    both = identity(f"{other},{tmp_path / 'depth'}")
    assert both == identity(str(one))
    assert both != identity(str(other))
    with pytest.raises(StudyError, match="CONTROLNET .* is no folder"):
        identity(f"{other},{tmp_path / 'none'}")


def test_one_answer_of_an_ambiguous_edit_can_be_asked_for_in_other_words(folder):
    edits = {"ball": {"some_colour=blue": "make the ball blue"}}
    study = load(folder, editing={**STUDY["editing"], "edits": edits})
    cells = cells_of(study, {name: load_scene(name) for name in study.scenes})
    edit = next(c for c in cells if c.probe == "editing").spec["edit"]
    blue = load_scene(study.scenes[0]).edited("some_colour", "blue").content_hash
    assert (edit["instruction"], edit["answers"]) == ("make the ball blue", [["blue", blue]])


one_thread = pytest.fixture(on_one_thread, autouse=True, scope="module")
