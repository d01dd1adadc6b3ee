"""Oracles: what the YAML says, counted and named by hand."""

import os
import pathlib
import re

import pytest
import trimesh
import yaml
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_eval.report.measured import measured
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, StudyError, cells_of, load_study
from attnwarp_eval.study.results import Outcome, Results
from attnwarp_eval.study.run import expected, plan, stored_study, verify
from attnwarp_eval.study.shared import edits, encoders
from attnwarp_eval.study.study import scene_files, shipped_studies

SMALL = {
    "name": "small",
    "size": 64,
    "scenes": ["spheres"],
    "views": ["yaw030", "yaw090"],
    "feature_sizes": [64, 16],
    "spp": 1,
    "splats": {"count": 500},
    "variants": {
        "corrected": {"preset": "corrected"},
        "again": {"preset": "corrected", "set": {"in_front": True}},
        "slipped": {"preset": "corrected", "set": {"pixel_centers": "integer"}},
    },
    "probes": {
        "depth": ["corrected", "again", "slipped"],
        "warp": ["corrected", "again", "slipped"],
    },
}


def write(folder, **changes):
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return str(path)


def cells(study):
    return cells_of(study, {name: load_scene(name) for name in scene_files(study)})


@pytest.mark.parametrize("name", list(shipped_studies()))
def test_every_shipped_study_loads_and_names_scenes_that_exist(name, monkeypatch):
    # Which weights an encoder or an editor has is part of a cell's id; that they are there is tested
    # where they are.
    monkeypatch.setattr(encoders, "identity", lambda name, kind: {"weights_sha256": name})
    monkeypatch.setattr(edits, "files_digest", lambda name: name)
    study = load_study(name)
    assert study.title
    if study.population:  # its scenes are of one generator
        study = study.model_copy(update={"scenes": study.scenes[:2]})
    planned = cells(study)
    assert len({cell.id for cell in planned}) == len(planned) > 0


def test_variants_of_the_same_content_share_a_cell_and_keep_both_names(tmp_path):
    result = cells(load_study(write(tmp_path)))
    # Pixel centres play no part in a depth map, so all three variants are one cell there and two in
    # the warp.
    assert [(c.probe, c.labels) for c in result] == [
        ("calibration", ("calibration",)),
        ("depth", ("corrected", "again", "slipped")),
        ("warp", ("corrected", "again")),
        ("warp", ("slipped",)),
    ]


def test_ids_change_with_the_content_and_not_with_the_names(tmp_path):
    ids = {c.labels[0]: c.id for c in cells(load_study(write(tmp_path))) if c.probe == "warp"}
    renamed = {"x": SMALL["variants"]["corrected"], "y": SMALL["variants"]["slipped"]}
    again = cells(load_study(write(tmp_path, variants=renamed, probes={"warp": ["x", "y"]})))
    assert {c.id for c in again if c.probe == "warp"} == set(ids.values())
    other = cells(load_study(write(tmp_path, splats={"count": 501})))
    assert not {c.id for c in other} & set(ids.values())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sizes": 64}, "sizes: unknown key 'sizes'; did you mean 'size'"),
        ({"size": "large"}, "size: got 'large', but .*integer"),
        ({"probes": {"warp": ["corected"]}}, "no variant 'corected'; did you mean 'corrected'"),
        ({"seeds": [0, 0]}, "named twice"),
        ({"seeds": [True]}, r"seeds\[0\]: got True, expected a whole number"),
        ({"name": "../escape"}, "name: .*pattern"),
        ({"feature_sizes": [128]}, "expected 1 to 64, the image size"),
        (
            {"ablations": [{"title": "t", "probe": "fit", "baseline": "again", "variants": ["b"]}]},
            "add it to probes.fit",
        ),
        (
            {
                "fronts": [
                    {
                        "title": "t",
                        "probe": "warp",
                        "metric": "warp.epe_medain.64",
                        "variants": ["again"],
                    }
                ]
            },
            "no metric 'warp.epe_medain.64'; did you mean 'warp.epe_median'",
        ),
        (
            {
                "fronts": [
                    {"title": "t", "probe": "warp", "metric": "occlusion.f1", "variants": ["again"]}
                ]
            },
            "less is better",
        ),
        (
            {"encoders": {"clip": "clip-smal"}},
            r"encoders.clip: encoder 'clip-smal': unknown; did you mean 'clip-small'",
        ),
        (
            {"variants": {}, "probes": {"warp": []}},
            "variants: got none, expected at least one for probes.warp",
        ),
        ({"probes": {"warp": []}}, "probes.warp: names no variant, expected at least one"),
        ({"splats": {"position_noise": float("inf")}}, "position_noise: got inf, but .*finite"),
        (
            {
                "fronts": [
                    {
                        "title": "t",
                        "probe": "warp",
                        "metric": "warp.epe_median.{size}",
                        "variants": ["again"],
                    }
                ]
            },
            "braces may hold 'layer' alone",
        ),
    ],
)
def test_a_wrong_study_says_where_and_what_to_do(tmp_path, changes, message):
    path = write(tmp_path, **changes)
    with pytest.raises(StudyError, match=message) as caught:
        load_study(path)
    assert path in str(caught.value)


@pytest.mark.parametrize(
    ("tables", "expected"),
    [
        ([], ["attnwarp-eval: in no table of the report: depth of corrected, again, slipped; warp of corrected, again, slipped;"]),

        ([("warp", ["again"]), ("depth", ["again", "slipped"])], ["attnwarp-eval: in no table of the report: warp of slipped;"]),
        ([("warp", ["again", "slipped"]), ("depth", ["again", "slipped"])], []),
    ],
)  # fmt: skip
def test_variants_that_no_table_would_show_are_named_before_they_are_computed(
    tmp_path, tables, expected
):
    ablations = [
        {"title": probe, "probe": probe, "baseline": "corrected", "variants": variants}
        for probe, variants in tables
    ]
    path = write(tmp_path, ablations=ablations)
    done = CliRunner().invoke(app, ["run", path, "--dry-run", "--out", str(tmp_path / "run")])
    assert done.exit_code == 0
    lines = [line for line in done.stderr.splitlines() if "one computation" not in line]
    assert [line.partition(" a table")[0] for line in lines] == expected


@pytest.mark.parametrize(
    ("probe", "own", "told"),
    [
        ("warp", {"control": "mirrored"}, r"variants.own.control: no probe .*\(warp\) reads it"),
        ("warp", {"mask": "truth"}, "variants.own.mask"),
        ("warp", {"options": {"a0": 0}}, "variants.own.options"),
        ("warp", {"geometry": "truth", "splats": {"count": 9}}, "variants.own.splats"),
        ("depth", {"set": {"pixel_centers": "integer"}}, "differs from 'plain' in pixel_centers"),
    ],
)
def test_a_key_that_no_probe_of_the_variant_reads_is_refused(tmp_path, probe, own, told):
    path = write(tmp_path, variants={"plain": {}, "own": own}, probes={probe: ["plain", "own"]})
    with pytest.raises(StudyError, match=told):
        plan(load_study(path), Store(tmp_path / "run"))
    result = CliRunner().invoke(app, ["run", path, "--dry-run"])
    assert result.exit_code == 2


def test_a_probe_without_a_cell_on_these_scenes_refuses_no_key(tmp_path):
    # The bear alone has words for the probe `carry`, some of whose variants have options.
    assert plan(load_study("quick", scenes=["spheres"]), Store(tmp_path / "run")).cells


def test_variants_that_are_one_computation_are_named(tmp_path):
    path = write(tmp_path)
    shown = CliRunner().invoke(app, ["run", path, "--dry-run", "--out", str(tmp_path / "run")])
    assert "equal rows of depth: corrected, again, slipped\n" in shown.stderr
    assert "equal rows of warp: corrected, again\n" in shown.stderr
    cells_of_run = plan(load_study(path), Store(tmp_path / "run")).cells
    outcomes = [
        Outcome(c.id, c.title, c.scene, c.labels, c.probe, c.seed, None) for c in cells_of_run
    ]
    text = "\n".join(measured(Results(load_study(path), outcomes, [])).text)
    assert "One computation, so equal rows of `warp`: corrected, again." in text


def test_a_scene_in_place_of_a_study_is_told_as_one(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("name: own\nobjects: []\nlights: []\ncameras: {}\n")
    with pytest.raises(StudyError) as caught:
        load_study(str(path))
    assert str(caught.value) == (
        f"{path}: is a scene; name it under 'scenes' in a study, or as run STUDY --scenes {path}"
    )


@pytest.mark.door
def test_a_view_that_a_scene_lacks_is_named(tmp_path):
    with pytest.raises(StudyError, match="'yaw031'; did you mean 'yaw030'"):
        cells(load_study(write(tmp_path, views=["yaw031"])))


@pytest.mark.door
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {
                "scenes": ["bear", "dinosaur"],
                "editing": {"edits": {"baer": {"snow": None}}},
                "probes": SMALL["probes"] | {"editing": ["again"]},
            },
            "editing.edits: the study has no scene 'baer'; did you mean 'bear'",
        ),
        (
            {"pictures": {"variants": ["again"], "views": ["yaw030", "yaw35"]}},
            "pictures.views: no scene has a view 'yaw35'; did you mean 'yaw",
        ),
    ],
)
def test_a_key_that_names_nothing_of_any_scene_is_refused(tmp_path, changes, message):
    path = write(tmp_path, **{"scenes": ["spheres", "opposed"], "views": [], **changes})
    for chosen in (None, load_study(path).scenes[1:]):
        with pytest.raises(StudyError, match=message):
            plan(load_study(path, scenes=chosen), Store(tmp_path / "run"))
    result = CliRunner().invoke(app, ["run", path, "--dry-run", "--out", str(tmp_path / "run")])
    assert result.exit_code == 2 and message.split(":")[0] in result.stderr


def test_keys_may_name_scenes_that_are_left_out(tmp_path):
    named = {
        "editing": {"edits": {"dinosaur": {"stone": None}}},
        "pictures": {"variants": ["again"], "views": ["yaw030", "yaw165", "orbit_000_of_9"]},
    }  # yaw165 is a view of opposed alone, orbit_000_of_9 one of the fits
    probes = {"warp": ["again"], "fit": ["again"], "editing": ["again"]}
    path = write(tmp_path, scenes=["bear", "opposed", "dinosaur"], views=[], probes=probes,
                 fit={"views": 9}, variants={"again": {}}, **named)  # fmt: skip
    planned = plan(load_study(path, scenes=["bear"]), Store(tmp_path / "run"))
    pictured = {cell.probe: cell.pictures for cell in planned.cells}
    assert (pictured["warp"], pictured["fit"]) == (("yaw030",), ("orbit_000_of_9",))


def test_scenes_that_are_left_out_are_not_loaded_for_their_names(tmp_path, monkeypatch):
    own = {"editing": {"edits": {"drawn-1": {"recolor": None}}}, "variants": {"again": {}}}
    path = write(tmp_path, scenes=["bear", "elsewhere/drawn-1.yaml"], views=["yaw030"],
                 probes={"editing": ["again"]}, **own)  # fmt: skip
    loaded = []
    monkeypatch.setattr(
        "attnwarp_eval.study.run.load_scene", lambda name: loaded.append(name) or load_scene(name)
    )
    plan(load_study(path, scenes=["bear"]), Store(tmp_path / "run"))
    assert loaded == ["bear"]


def test_feature_grids_follow_the_image_where_a_study_names_none(tmp_path):
    study = {k: v for k, v in SMALL.items() if k != "feature_sizes"}
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(study))
    assert load_study(str(path)).feature_sizes == [64, 8, 4]
    assert load_study(str(path), size=128).feature_sizes == [128, 16, 8]


def test_relative_paths_count_from_the_studys_file(tmp_path, monkeypatch):
    own = tmp_path / "studies" / "scenes" / "own.yaml"
    own.parent.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    shipped = pathlib.Path(__file__).parents[3] / "scenes" / "spheres.yaml"
    own.write_text(shipped.read_text())
    path = tmp_path / "studies" / "study.yaml"
    path.write_text(
        "name: s\nscenes: [scenes/own.yaml, bear, /abs/other.yaml]\nvariants: {v: {}}\nprobes: {warp: [v]}\n"
        "encoders: {clip: 'clip:models/clip', dino: dino-small, perceptual: 'lpips:/abs/lpips'}\n"
    )
    for folder in (tmp_path, tmp_path / "elsewhere"):
        monkeypatch.chdir(folder)
        study = load_study(os.path.relpath(path))
        assert pathlib.Path(study.scenes[0]).samefile(own)
        assert study.scenes[1:] == ["bear", "/abs/other.yaml"]
        clip = study.encoders["clip"].removeprefix("clip:")
        assert os.path.realpath(clip) == str(tmp_path / "studies" / "models" / "clip")
        assert study.encoders["dino"] == "dino-small"
        assert study.encoders["perceptual"] == "lpips:/abs/lpips"
        # Reports call a scene by its name, wherever its file lies.
        assert study.scene_names == ["own", "bear", "other"]
    # What a person types on the command line counts from where they are.
    typed = load_study(os.path.relpath(path), scenes=["x/y.yaml"])
    assert typed.scenes == [str(tmp_path / "elsewhere" / "x" / "y.yaml")]


def test_two_files_of_one_name_are_called_by_their_paths_and_a_name_chooses_a_file(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text(
        "name: s\nscenes: [a/room.yaml, b/room.yaml, bear.yaml]\nvariants: {v: {}}\nprobes: {warp: [v]}\n"
    )
    files = [str(tmp_path / name) for name in ("a/room.yaml", "b/room.yaml", "bear.yaml")]
    assert load_study(str(path)).scene_names == [*files[:2], "bear"]
    # The study's own file, not the scene of that name which comes along.
    assert load_study(str(path), scenes=["bear"]).scenes == [files[2]]


def test_a_scene_of_a_file_has_its_name_in_cells_and_its_file_beside_it(tmp_path):
    shipped = pathlib.Path(__file__).parents[3] / "scenes" / "spheres.yaml"
    (tmp_path / "room.yaml").write_text(shipped.read_text())
    path = tmp_path / "study.yaml"
    path.write_text(
        "name: s\nscenes: [room.yaml]\nsize: 16\nvariants: {a: {}}\nprobes: {depth: [a]}\n"
    )
    study, store = load_study(str(path)), Store(tmp_path / "run")
    planned = plan(study, store)
    assert {(c.scene, c.scene_file) for c in planned.cells} == {
        ("room", str(tmp_path / "room.yaml"))
    }
    store.write_study(expected(planned))
    assert {cell["scene"] for cell in stored_study(store).cells} == {"room"}
    assert not verify(store).damaged


BASE = """\
name: base
size: 64
scenes: [spheres]
views: [yaw030, yaw090]
spp: 1
splats: {count: 500, position_noise: 0.1}
variants:
  corrected: {}
  slipped: {set: {pixel_centers: integer, opaque: 0.9}}
  bare: {preset: released}
probes:
  depth: [corrected]
  warp: [corrected, slipped, bare]
yaw: {variants: [slipped]}
"""

CHILD = """\
extends: base.yaml
name: child
views: [yaw060]
splats: {count: 700}
variants:
  slipped: {set: {opaque: null, depth: center}}
  bare: null
  bounds only: {set: {opaque: null}}
probes:
  depth: null
  warp: [slipped, bounds only]
yaw: null
"""

BY_HAND = """\
name: child
size: 64
scenes: [spheres]
views: [yaw060]
spp: 1
splats: {count: 700, position_noise: 0.1}
variants:
  corrected: {}
  slipped: {set: {pixel_centers: integer, depth: center}}
  bounds only: {set: {opaque: null}}
probes:
  warp: [corrected, slipped, bounds only]
"""


def extending(folder, child=CHILD, base=BASE):
    (folder / "base.yaml").write_text(base)
    path = folder / "child.yaml"
    path.write_text(child)
    return str(path)


def test_a_study_that_extends_another_is_the_one_merged_by_hand(tmp_path):
    listed = CHILD.replace("[slipped, bounds only]", "[corrected, slipped, bounds only]")
    merged = load_study(extending(tmp_path, listed))
    (tmp_path / "by_hand.yaml").write_text(BY_HAND)
    by_hand = load_study(str(tmp_path / "by_hand.yaml"))
    assert merged.model_dump() == by_hand.model_dump()
    assert [cell.id for cell in cells(merged)] == [cell.id for cell in cells(by_hand)]


def test_a_shipped_study_is_extended_by_its_name(tmp_path):
    path = tmp_path / "larger.yaml"
    path.write_text("extends: gate\nname: larger\nsize: 160\nfeature_sizes: [160]\n")
    by_hand = load_study("gate", size=160).model_dump() | {
        "name": "larger",
        "feature_sizes": [160],
    }
    assert load_study(str(path)).model_dump() == by_hand


def test_scenes_of_meshes_replace_the_drawn_ones_of_the_study_that_is_extended(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.glb")
    base = BASE.replace("[spheres]", "{drawn: 9, generator: 1, seed: 7, axes: {thin: 0.5}}")
    meshes = "extends: base.yaml\nname: b\nscenes: {meshes: ., n: 1, seed: 3}\n"
    other = load_study(extending(tmp_path, meshes, base))
    assert other.scene_names == ["mesh-0"] and ", seed 3" in other.sampled
    fewer = "extends: base.yaml\nname: b\nscenes: {drawn: 1}\n"
    kept = load_study(extending(tmp_path, fewer, base))
    assert kept.sampled.endswith("drawn by generator 1, seed 7, thin 0.5")


def test_paths_of_an_extended_study_count_from_its_own_folder(tmp_path):
    (tmp_path / "far").mkdir()
    shipped = pathlib.Path(__file__).parents[3] / "scenes" / "spheres.yaml"
    (tmp_path / "far" / "room.yaml").write_text(shipped.read_text())
    (tmp_path / "far" / "base.yaml").write_text(BASE.replace("spheres", "room.yaml"))
    path = tmp_path / "child.yaml"
    path.write_text("extends: far/base.yaml\nname: child\n")
    assert load_study(str(path)).scenes == [str(tmp_path / "far" / "room.yaml")]


@pytest.mark.parametrize(
    ("child", "told"),
    [
        ("extends: bas.yaml\n", r"child.yaml:1: extends: no such study 'bas.yaml'"),
        ("name: a\nextends: [base.yaml]\n", r"child.yaml:2: extends: got \['base.yaml'\]"),
        ("name: a\nextends: child.yaml\n", r"child.yaml:2: extends: leads back to child.yaml"),
        ("extends: spheres.yaml\n", r"spheres.yaml: is a scene"),
        # A key that the child wrote, one that it left to the base, and one that it took away.
        ("extends: base.yaml\nviews: [yaw030]\nspp: none\n", r"child.yaml:3: spp"),
        ("extends: base.yaml\nsplats:\n  kind: 4d\n", r"child.yaml:3: splats.kind"),
        ("extends: base.yaml\nvariants:\n  x: null\n", r"child.yaml:3: .* has none of this name"),
    ],
)
def test_a_mistake_in_a_study_that_extends_another_has_its_file_and_line(tmp_path, child, told):
    shipped = pathlib.Path(__file__).parents[3] / "scenes" / "spheres.yaml"
    (tmp_path / "spheres.yaml").write_text(shipped.read_text())
    with pytest.raises(StudyError, match=told):
        load_study(extending(tmp_path, child))


@pytest.mark.parametrize(
    ("was", "is_now", "told"),
    [
        ("spp: 1", "spp: none", r"base.yaml:5: spp"),
        ("name: base", "name: [", r"base.yaml:\d+: not valid YAML"),
        ("name: base", "name: base\nextends: child.yaml", r"base.yaml:2: .*leads back to child"),
    ],
)
def test_a_mistake_in_an_extended_study_has_its_own_file_and_line(tmp_path, was, is_now, told):
    path = extending(tmp_path, "extends: base.yaml\nname: a\n", BASE.replace(was, is_now))
    with pytest.raises(StudyError, match=told):
        load_study(path)


@pytest.mark.parametrize(
    ("variant", "probe", "message"),
    [
        ("{method: igs2gs, preset: corrected}", "editing", "preset: got 'corrected', expected one of"),
        ("{options: {seed: 3}}", "editing", "options.seed: the seeds are the study's own"),
        ("{fit: {seed: 3}}", "fit", "fit.seed: the seeds are the study's own"),
    ],
)  # fmt: skip
def test_a_variant_that_cannot_be_measured_is_refused_with_its_line(
    tmp_path, variant, probe, message
):
    path = tmp_path / "study.yaml"
    path.write_text(
        f"name: a\nscenes: [bear]\nvariants:\n  v: {variant}\nprobes: {{{probe}: [v]}}\n"
    )
    with pytest.raises(StudyError, match=f"study.yaml:4: variants.v: {message}"):
        load_study(str(path))


def test_a_variant_that_no_probe_measures_is_refused_with_its_line(tmp_path):
    with pytest.raises(StudyError, match=r"study.yaml:\d+: variants.slipped: no probe measures it"):
        load_study(write(tmp_path, probes={"warp": ["again", "corrected"]}))


def test_a_study_of_fewer_probes_leaves_out_the_variants_that_it_does_not_measure(tmp_path):
    child = "extends: base.yaml\nname: a\nprobes: {warp: null}\nyaw: null\n"
    assert list(load_study(extending(tmp_path, child)).variants) == ["corrected"]
    with pytest.raises(StudyError, match=r"child.yaml:5: variants.own: no probe measures it"):
        load_study(extending(tmp_path, f"{child}variants: {{own: {{}}}}\n"))


@pytest.mark.parametrize(
    ("key", "table"),
    [
        ("ablations[0]", "[{title: t, probe: warp, baseline: corrected, variants: [bare]}]"),
        ("fronts[0]", "[{title: t, probe: warp, metric: 'warp.epe_median.64', variants: [bare]}]"),
        ("answer", "{question: q, decides: c, variants: {slipped: a, bare: b},"
         " columns: {c: {metric: occlusion.recall, probe: warp}}}"),
        ("yaw.variants", "{variants: [bare]}"),
        ("pictures.variants", "{variants: [corrected, bare]}"),
    ],
)  # fmt: skip
def test_a_table_of_the_extended_study_that_this_one_does_not_measure_is_refused(
    tmp_path, key, table
):
    name = re.match("[a-z]+", key)[0]
    base = BASE.replace("yaw: {variants: [slipped]}\n", "") + f"{name}: {table}\n"
    child = "extends: base.yaml\nname: a\nprobes: {warp: null}\n"
    remedy = f"child.yaml may have {name} of its own, or '{name}: null'"
    with pytest.raises(StudyError, match=rf"base.yaml:14: {re.escape(key)}.*; {remedy}"):
        load_study(extending(tmp_path, child, base))
    without = load_study(extending(tmp_path, f"{child}{name}: null\n", base))
    assert list(without.variants) == ["corrected"]


@pytest.mark.parametrize(
    ("table", "place"),
    [
        ("ablations: [{title: t, baseline: a, variants: [b]}]", "ablations[0]"),
        ("fronts: [{title: t, metric: warp.epe_median, variants: [b]}]", "fronts[0]"),
        ("answer: {question: q, variants: {a: A, b: B}, decides: c, columns: {c: {metric: m}}}",
         "answer.columns.c"),
        ("answer: {question: q, variants: {a: A, b: B}, decides: c, columns: {c: {metric:"
         " occlusion.recall, probe: warp}}, pictures: [{caption: x, content: y, variants: [b]}]}",
         "answer.pictures[0]"),
    ],
)  # fmt: skip
def test_a_table_that_names_no_probe_is_told_which_line_to_write(tmp_path, table, place):
    path = tmp_path / "study.yaml"
    path.write_text(
        "name: s\nscenes: [spheres]\nvariants: {a: {}, b: {preset: released}}\n"
        f"probes: {{timing: [a, b], warp: [a, b], depth: [a]}}\n{table}\n"
    )
    told = f"study.yaml:5: {place}.probe: is missing; write 'probe: warp' or 'probe: depth'"
    with pytest.raises(StudyError, match=re.escape(told)):
        load_study(str(path))
