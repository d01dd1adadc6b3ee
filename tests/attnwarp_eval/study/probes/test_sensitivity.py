"""Oracles: pictures of one colour whose blends follow by hand, colorsys, and encoders whose
embeddings are means of pixels.
"""

import colorsys
import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from ball_scene import any_colour, ball_scene

from attnwarp.encoders import EncoderInfo
from attnwarp.errors import InputError
from attnwarp_eval.colors import to_srgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study, shared
from attnwarp_eval.study.flawed_edits import CONDITIONS, RIGHT, Shot, Task, opposite_hue, tasks
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.work import compute
from attnwarp_eval.truth import appearance

BOX = {
    "name": "box",
    "shape": {"type": "box", "center": [0.3, 1.6, 0.3], "size": [0.6, 0.6, 0.6]},
    "texture": {"type": "checker", "colors": ["#c0c0c0", "#d0d0d0"], "size": 0.3},
}
SCENE = ball_scene(
    "A ball and a box on the ground",
    0.8,
    ("#3050c0", "#4060d0"),
    {"look_at": [0, 0, 0.7], "radius": 4, "targets": (15, 30)},
    [
        {
            "name": "green",
            "instruction": "Make the ball green",
            "source": "a blue ball",
            "target": "a green ball",
            "changes": [{"object": "ball", "paint": "#30c050"}],
        },
        {
            "name": "orange_box",
            "instruction": "Make the box orange",
            "source": "a grey box",
            "target": "an orange box",
            "changes": [{"object": "box", "paint": "#e08020"}],
        },
        any_colour(
            "any",
            "Paint the ball",
            "a blue ball",
            "a bright ball",
            {"red": "#d02020", "yellow": "#e0d020", "white": "#f0f0f0", "pink": "#f080b0"},
        ),
        {
            "name": "dusk",
            "instruction": "Make it dusk",
            "source": "by day",
            "target": "at dusk",
            "lights": [{"type": "sky", "horizon": "#f0a060", "zenith": "#604060", "radiance": 0.5}],
        },
    ],
    objects=[BOX],
)
WORDS = {
    "a blue ball": (0, 0, 1),
    "a green ball": (0, 1, 0),
    "a grey box": (1, 1, 1),
    "an orange box": (1, 0.5, 0),
}


@dataclasses.dataclass
class Fake:
    """An embedding is the mean colour of the picture; a distance the mean absolute difference."""

    about: EncoderInfo

    def images(self, images):
        return np.array([np.asarray(image, dtype=np.float64).mean((0, 1)) for image in images])

    def texts(self, texts):
        return np.array([WORDS[text] for text in texts], dtype=np.float64)

    def distance(self, a, b):
        return np.array([np.abs(x - y).mean() for x, y in zip(a, b, strict=True)])


def fake(name, weights="w"):
    kind = name.partition("-")[0]
    return Fake(
        EncoderInfo(name, kind, f"/somewhere/{name}", f"{kind}-{weights}", "as it is", None, 3)
    )


@pytest.fixture
def encoders(monkeypatch):
    """The bundled encoders' names, with fakes behind them; ``weights`` says which."""
    state = SimpleNamespace(weights="w")
    monkeypatch.setattr(
        shared.encoders, "load_encoder", lambda name, kind=None: fake(name, state.weights)
    )
    return state


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "ball.yaml"
    path.write_text(yaml.safe_dump(SCENE))
    return path


def study(scene, folder, **changes):
    said = {
        "name": "small",
        "size": 32,
        "scenes": [str(scene)],
        "feature_sizes": [32],
        "spp": 4,
        "timing_rounds": 3,
        "encoders": {"clip": "clip-small", "dino": "dino-small", "perceptual": "perceptual-small"},
        "edits": ["green", "orange_box"],
        "probes": {"sensitivity": []},
        **changes,
    }
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(said))
    return load_study(str(path))


def cell_of(scene, folder, **changes):
    made = study(scene, folder, **changes)
    cells = cells_of(made, {name: load_scene(name) for name in made.scenes})
    assert [c.probe for c in cells] == ["calibration", "sensitivity"]
    return cells[1]


def shot(**changes):
    """A picture of 8 x 12 px, dark grey before the edit, light orange after, its left half
    edited."""
    before, after = np.full((8, 12, 3), 0.1), np.broadcast_to([0.8, 0.6, 0.2], (8, 12, 3)).copy()
    mask = np.zeros((8, 12), dtype=bool)
    mask[:, :6] = True
    return Shot(
        **{
            "index": 1,
            "before": before,
            "after": after,
            "mask": mask,
            "hue": np.array([0, 1.0, 1]),
            **changes,
        }
    )


def picture(name, of, seed=0):
    return next(c for c in CONDITIONS if c.name == name).picture(of, seed)


def test_strength_blends_in_linear_light_and_ends_at_the_two_pictures():
    of = shot()
    np.testing.assert_allclose(picture("strength_025", of)[0, 0], to_srgb([0.275, 0.225, 0.125]))
    np.testing.assert_array_equal(picture("strength_000", of), to_srgb(of.before))
    np.testing.assert_array_equal(picture(RIGHT, of), to_srgb(of.after))


def test_a_wrong_colour_keeps_the_value_inside_the_mask_and_everything_outside():
    result = picture("wrong_colour", shot())
    np.testing.assert_allclose(result[0, 0], to_srgb([0.2, 0.8, 0.8]))  # 0.8 (1 - 0.75), 0.8, 0.8
    np.testing.assert_array_equal(result[:, 6:], picture(RIGHT, shot())[:, 6:])


@pytest.mark.parametrize("color", [(0.8, 0.6, 0.2), (0.1, 0.2, 0.9), (0.5, 0.1, 0.4)])
def test_the_wrong_hue_is_half_a_circle_away(color):
    hue, _, _ = colorsys.rgb_to_hsv(*color)
    np.testing.assert_allclose(
        opposite_hue(np.array(color)), colorsys.hsv_to_rgb((hue + 0.5) % 1, 1, 1), atol=1e-12
    )


def test_grey_has_no_hue_and_still_gets_a_wrong_colour():
    np.testing.assert_array_equal(opposite_hue(np.full(3, 0.3)), [1, 0, 0])


def test_an_edit_of_several_answers_takes_the_others_for_what_is_wrong():
    others = (np.full((8, 12, 3), 0.3), np.full((8, 12, 3), 0.4))
    of = shot(others=others)
    np.testing.assert_array_equal(picture("wrong_colour", of), to_srgb(others[0]))
    np.testing.assert_array_equal(picture("inconsistent", of), to_srgb(others[1]))
    np.testing.assert_array_equal(
        picture("inconsistent", shot(others=others, index=2)), to_srgb(others[0])
    )


def test_views_that_disagree_leave_the_source_right_and_others_carry_their_flaw_there_too():
    source = shot(index=0)
    for name in ("inconsistent", "misplaced"):
        np.testing.assert_array_equal(picture(name, source), to_srgb(source.after))
    for name in ("strength_050", "wrong_colour", "noisy"):
        assert not np.array_equal(picture(name, source), to_srgb(source.after))
    one, other = picture("inconsistent", shot(index=1)), picture("inconsistent", shot(index=2))
    np.testing.assert_allclose(one[0, 0], to_srgb([0.625, 0.475, 0.175]))
    np.testing.assert_allclose(other[0, 0], to_srgb([0.45, 0.35, 0.15]))


def test_blur_keeps_the_light_and_misplacing_moves_two_pixels():
    after = np.zeros((128, 128, 3))
    after[64, 64] = 1
    of = shot(before=after, after=after, mask=np.ones((128, 128), bool))
    blurred = of.blurred()
    assert blurred.sum() == pytest.approx(3, rel=1e-9)
    variance = (blurred[..., 0].sum(0) * (np.arange(128) - 64.0) ** 2).sum()
    assert math.sqrt(variance) == pytest.approx(
        2 * 128 / 256, rel=0.01
    )  # a sampled Gaussian, cut at four sigma
    assert of.misplaced()[64, 66].tolist() == [1, 1, 1]
    assert of.misplaced().shape == after.shape


def test_noise_has_its_standard_deviation_is_another_in_each_view_and_the_same_again():
    grey = np.full((64, 64, 3), 0.2)
    of = shot(before=grey, after=grey, mask=np.ones((64, 64), bool))
    noise = picture("noisy", of) - to_srgb(grey)
    assert noise.std() == pytest.approx(0.05, rel=0.03)  # 12288 draws: 0.6 % standard error
    again = picture("noisy", of)
    np.testing.assert_array_equal(again, noise + to_srgb(grey))
    assert (
        abs(
            np.corrcoef(
                noise.ravel(),
                (picture("noisy", shot(**{**vars(of), "index": 2})) - to_srgb(grey)).ravel(),
            )[0, 1]
        )
        < 0.05
    )


def test_every_edit_is_asked_and_ambiguous_ones_two_answers_at_most(scene):
    result = {task.name: task for task in tasks(load_scene(str(scene)))}
    assert list(result) == ["green", "orange_box", "any-red", "any-yellow", "dusk"]
    assert [name for name, _ in result["any-red"].others] == ["yellow", "white"]
    assert result["any-red"].target == "a red ball"
    # The ball's edits are wrong in place of the box's and the other way round; light is nobody's
    # object.
    elsewhere = {name: task.elsewhere[0] for name, task in result.items()}
    assert elsewhere["green"] == elsewhere["any-red"] == "orange_box"
    assert elsewhere["orange_box"] == "any"
    assert elsewhere["dusk"] == "green"
    assert result["green"].content == load_scene(str(scene)).edited("green").content_hash
    for task in result.values():
        assert Task.from_dict(task.to_dict()) == task


def test_where_all_edits_change_one_object_nothing_is_a_wrong_object(tmp_path):
    path = tmp_path / "ball.yaml"
    path.write_text(yaml.safe_dump({**SCENE, "edits": [SCENE["edits"][0], SCENE["edits"][2]]}))
    assert {task.elsewhere for task in tasks(load_scene(str(path)))} == {None}


def test_the_cells_id_follows_the_weights_and_not_where_they_lie(scene, tmp_path, encoders):
    first = cell_of(scene, tmp_path)
    renamed = cell_of(
        scene,
        tmp_path,
        encoders={"clip": "clip:/elsewhere", "dino": "dino-small", "perceptual": "lpips:/l"},
    )
    assert first.sources != renamed.sources
    assert {k: v["weights_sha256"] for k, v in first.spec["encoders"].items()} == {
        "clip": "clip-w", "dino": "dino-w", "perceptual": "perceptual-w"
    }  # fmt: skip
    encoders.weights = "other"
    assert cell_of(scene, tmp_path).id != first.id
    assert cell_of(scene, tmp_path, edits=["green"]).id != first.id


def test_weights_that_change_under_a_run_are_refused(scene, tmp_path, encoders):
    cell = cell_of(scene, tmp_path)
    encoders.weights = "other"
    with pytest.raises(
        InputError, match="'clip-small': its weights have changed since the run was planned"
    ):
        compute(probe("sensitivity"), cell, tmp_path, threads=1)


@pytest.mark.door
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edits": ["gren"]}, "edits: no scene has an edit 'gren'; did you mean 'green'"),
        ({"scenes": ["spheres"], "edits": []}, "scene 'spheres' names no edits"),
        (
            {"scenes": ["SCENE", "bear"]},
            "edits: scene 'bear' has none of green, orange_box; there are polar",
        ),
        ({"encoders": {"clip": "clip:/nowhere"}}, "encoders.clip: .*/nowhere"),
    ],
)
def test_what_cannot_be_asked_says_why(scene, tmp_path, changes, message, request):
    if "encoders" not in changes:
        request.getfixturevalue("encoders")
    if "scenes" in changes:
        changes = {
            **changes,
            "scenes": [str(scene) if s == "SCENE" else s for s in changes["scenes"]],
        }
    with pytest.raises(StudyError, match=message):
        cell_of(scene, tmp_path, **changes)


@pytest.fixture
def record(scene, tmp_path, encoders):
    cell = cell_of(scene, tmp_path)
    return compute(probe("sensitivity"), cell, tmp_path, threads=1).to_json()


def cosine(a, b):
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))


def test_every_metric_of_every_condition_is_recorded_with_its_value(record, scene):
    assert [view["view"] for view in record["views"]] == [
        f"{edit}/yaw0{yaw}" for edit in ("green", "orange_box") for yaw in (15, 30)
    ]
    assert [view["yaw"] for view in record["views"]] == [15, 30, 15, 30]
    figures = record["views"][0]["metrics"]
    names = {key.rpartition(".")[0] for key in figures}
    assert len(figures) == len(names) * len(CONDITIONS)
    assert {
        "embedding.clip_directional",
        "embedding.dino_image",
        "fidelity.distance.inside",
    } <= names

    # The same by hand: pictures from the renderer, embeddings as means of pixels.
    at = load_scene(str(scene)).with_size(32, 32)
    camera = at.targets[0]
    before, after = (
        np.clip(appearance(s, camera, spp=4, seed=0), 0, 1) for s in (at, at.edited("green"))
    )
    half = to_srgb((before + after) / 2).astype(np.float64)
    mean = half.mean((0, 1))
    green, blue = np.array([0, 1.0, 0]), np.array([0, 0, 1.0])
    assert figures["embedding.clip_similarity.strength_050"] == pytest.approx(
        cosine(mean, green), abs=1e-6
    )
    unedited = to_srgb(before).mean((0, 1), dtype=np.float64)
    change = mean / np.linalg.norm(mean) - unedited / np.linalg.norm(unedited)
    # The change is a small difference of means of float32 pictures.
    assert figures["embedding.clip_directional.strength_050"] == pytest.approx(
        cosine(change, green - blue), abs=1e-3
    )
    source = to_srgb(np.clip(appearance(at.edited("green"), at.source, spp=4, seed=0), 0, 1)).mean(
        (0, 1)
    )
    assert figures["embedding.dino_image.strength_050"] == pytest.approx(
        cosine(mean, source), abs=1e-6
    )
    error = ((half - to_srgb(after)) ** 2).mean()
    assert figures["fidelity.mse.strength_050"] == pytest.approx(error, rel=1e-4)
    distance = np.abs(half - to_srgb(after)).mean()
    assert figures["fidelity.distance.strength_050"] == pytest.approx(distance, rel=1e-4)


def test_what_is_undefined_is_null_and_what_is_equal_has_its_mse(record):
    figures = record["views"][0]["metrics"]
    assert figures[f"fidelity.psnr.{RIGHT}"] is None  # infinite
    assert figures[f"fidelity.mse.{RIGHT}"] == 0
    assert figures["embedding.clip_directional.strength_000"] is None  # nothing changed


def test_seconds_are_taken_in_turn_for_every_metric(record):
    rounds = record["cost"]["rounds"]
    assert set(rounds) == {
        "fidelity.mse",
        "fidelity.ssim",
        "fidelity.distance",
        "consistency.delta_e",
        "embedding.clip_similarity",
        "embedding.clip_directional",
        "embedding.clip_image",
        "embedding.dino_image",
    }
    assert all(len(taken) == 3 and min(taken) > 0 for taken in rounds.values())


def test_without_encoders_their_metrics_are_left_out_and_a_missing_flaw_is_undefined(
    scene, tmp_path, encoders
):
    path = tmp_path / "one.yaml"
    path.write_text(yaml.safe_dump({**SCENE, "edits": SCENE["edits"][:1]}))
    cell = cell_of(path, tmp_path, encoders={}, edits=[])
    record = compute(probe("sensitivity"), cell, tmp_path, threads=1).to_json()
    result = record["views"][0]["metrics"]
    assert not any(key.startswith(("embedding", "fidelity.distance")) for key in result)
    assert result["fidelity.mse.wrong_object"] is None
    assert result["fidelity.mse.wrong_colour"] > 0
