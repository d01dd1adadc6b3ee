"""Oracles: scenes drawn outside the study, and the same study told in files."""

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import trimesh

from attnwarp.errors import InputError
from attnwarp_eval.drawn.files import to_text
from attnwarp_eval.drawn.scenes import draw
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, StudyError, load_study
from attnwarp_eval.study.run import plan
from attnwarp_eval.study.study import cells_of, parse_study, scene_files

STUDY = """\
name: mine
size: 64
scenes: {drawn: 3, generator: 1, seed: 7, axes: {thin: 0.2}}
views: [yaw030]
variants: {corrected: {preset: corrected}}
probes: {warp: [corrected]}
"""


@pytest.fixture
def study_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(STUDY)
    return path


def test_a_study_of_a_population_has_its_scenes_by_short_names(study_file):
    study = load_study(str(study_file))
    assert study.scene_names == ["drawn-0", "drawn-1", "drawn-2"]
    assert study.sampled == "3 scenes drawn by generator 1, seed 7, thin 0.2"
    for k, name in enumerate(scene_files(study)):
        assert Path(name).read_text() == to_text(draw(k, 7, axes={"thin": 0.2}).data)


def test_cells_of_a_population_are_those_of_the_same_scenes_named_as_files(study_file, tmp_path):
    drawn = load_study(str(study_file))
    other = tmp_path / "files"
    other.mkdir()
    for name in scene_files(drawn):
        (other / Path(name).name).write_bytes(Path(name).read_bytes())
    by_file = load_study(str(study_file), scenes=sorted(map(str, other.glob("*.yaml"))))
    assert by_file.population is not None and by_file.scenes == drawn.scenes

    def ids(study):
        return [
            c.id for c in cells_of(study, {name: load_scene(name) for name in scene_files(study)})
        ]

    assert ids(drawn) == ids(by_file) and len(set(ids(drawn))) == 6


def test_a_part_of_a_population_says_so_and_other_scenes_are_no_sample(study_file):
    part = load_study(str(study_file), scenes=["drawn-2", "drawn-0"])
    assert part.scene_names == ["drawn-2", "drawn-0"]
    assert part.sampled.startswith("2 of 3 scenes drawn by generator 1")
    # A file of that name with another scene in it.
    other = study_file.parent / "drawn-1.yaml"
    other.write_text(to_text(draw(1, seed=8).data))
    assert load_study(str(study_file), scenes=[str(other)]).sampled == ""
    mixed = load_study(str(study_file), scenes=["drawn-2", "spheres"])
    assert mixed.sampled == "" and mixed.scene_names == ["drawn-2", "spheres"]


def test_drawn_scenes_beside_a_misspelt_one_are_drawn_and_not_blamed(study_file):
    study = load_study(str(study_file), scenes=["drawn-2", "bear-1"])
    assert Path(study.scenes[0]).read_text() == to_text(draw(2, 7, axes={"thin": 0.2}).data)
    with pytest.raises(InputError, match="bear-1.*did you mean 'bear'"):
        plan(study, Store(study_file.parent / "run"))


def test_a_stored_study_finds_its_scenes_on_a_machine_that_has_none_of_them(
    study_file, tmp_path, monkeypatch
):
    stored = load_study(str(study_file)).model_dump(mode="json")
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path / "elsewhere"))
    again = parse_study(stored)
    assert all(str(tmp_path) in name and Path(name).is_file() for name in scene_files(again))
    assert again.scene_names == ["drawn-0", "drawn-1", "drawn-2"]


def test_an_entry_for_the_population_is_one_for_each_of_its_scenes(study_file):
    study_file.write_text(
        STUDY.replace("probes: {warp: [corrected]}", "probes: {editing: [edited]}").replace(
            "{corrected: {preset: corrected}}", "{edited: {method: attention_warping}}"
        )
        + "editing: {edits: {drawn: {some_colour: null, ground: make it snow}}}\n"
    )
    study = load_study(str(study_file))
    wanted = {"some_colour": None, "ground": "make it snow"}
    assert study.editing.edits == dict.fromkeys(study.scene_names, wanted)


def test_meshes_of_a_folder_stand_upright_on_drawn_ground(tmp_path, monkeypatch):
    models = tmp_path / "models"
    models.mkdir()
    box = trimesh.creation.box((2.0, 6.0, 2.0)).apply_translation((5, 40, -3))
    box.export(models / "tower.glb")
    cone = trimesh.creation.cone(radius=0.5, height=3.0)
    cone.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))  # y is up
    cone.export(models / "cone.ply")
    (models / "._tower.glb").write_bytes(b"\0\5\x16\7")  # macOS' own
    path = tmp_path / "mine.yaml"
    path.write_text(STUDY.replace("{drawn: 3, generator: 1,", "{meshes: models, n: 3,"))
    study = load_study(str(path))
    assert study.scene_names == ["mesh-0", "mesh-1", "mesh-2"]
    assert study.sampled == "3 scenes of meshes of models drawn by generator 1, seed 7, thin 0.2"
    for name in scene_files(study):
        scene = load_scene(name)
        assert Path(name).with_name("meshes").is_dir() and len(scene.edits) == 7
        shapes = scene.shapes()
        for k, item in enumerate(scene.spec.objects):
            if item.shape.type == "mesh":
                low, high = next(s for s in shapes if s.object_id == k).bounds()
                assert low[2] == pytest.approx(0, abs=1e-3)
                assert (high - low)[2] > 1.3 * max((high - low)[:2]) and high[2] < 1.2
                assert all(low[:2] < scene.spec.cameras.radius) and all(
                    high[:2] > -scene.spec.cameras.radius
                )
    # A run is reported where its meshes are not.
    stored = study.model_dump(mode="json")
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path / "elsewhere"))
    models.rename(tmp_path / "gone")
    assert parse_study(stored).scene_names == study.scene_names


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ("{drawn: 3, seed: 7, axes: {oclusion: 1}}", "did you mean 'occlusion'"),
        pytest.param("{meshes: no, n: 3, seed: 7}", "no folder", marks=pytest.mark.door),
        pytest.param("{drawn: 3}", "seed: is missing", marks=pytest.mark.door),
        pytest.param(
            "{drawn: 3, seed: 7, generator: 2}", "generator: got 2", marks=pytest.mark.door
        ),
    ],
)
def test_a_population_that_cannot_be_is_refused_with_its_line(study_file, scenes, message):
    was = "{drawn: 3, generator: 1, seed: 7, axes: {thin: 0.2}}"
    study_file.write_text(STUDY.replace(was, scenes))
    with pytest.raises(StudyError) as error:
        load_study(str(study_file))
    assert message in str(error.value) and f"{study_file}:3: scenes: " in str(error.value)


def test_each_drawn_scene_has_noise_of_its_own_and_methods_share_it(tmp_path):
    """The seeds in the cells themselves; those of a scene's methods are equal."""
    (tmp_path / "my.yaml").write_text(
        "extends: ablation\nname: my\n"
        "probes: {editing: [corrected, each view alone]}\nablations: []\n"
        "fronts: []\npictures: null\n"
    )
    study = load_study(str(tmp_path / "my.yaml"), scenes=["drawn-2", "drawn-5"])
    seeds = defaultdict(set)
    for cell in cells_of(study, {name: load_scene(name) for name in scene_files(study)}):
        if cell.probe == "editing":
            seeds[cell.scene].add(cell.spec["settings"]["seed"])
    assert all(len(own) == 1 for own in seeds.values())
    assert len(set.union(*seeds.values())) == len(seeds) == 2
