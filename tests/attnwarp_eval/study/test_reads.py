"""Refusal, with its line, of what a study names and does not use. Oracles: lines counted by hand;
cells and results of two values of a setting, which are the same where nothing reads it.
"""

import dataclasses

import numpy as np
import pytest
import torch
import yaml
from ball_scene import SCENE
from pydantic import ValidationError
from tiny_scenes import cameras, pictures, splats

from attnwarp.editing.small import load_editor
from attnwarp.warp import WarpSettings, warp_view
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import StudyError, cells_of, load_study, parse_study
from attnwarp_eval.study.editing_methods import EDITING_METHODS, Job
from attnwarp_eval.study.probe import probe, probes
from attnwarp_eval.study.reads import MASK_RULES, warp_reads
from attnwarp_eval.study.shared import edits
from attnwarp_eval.study.warping import warp_truth
from attnwarp_eval.world import splats as sampled
from attnwarp_eval.world import world

HEAD = """name: mine
scenes: [ball.yaml]
size: 32
"""


def refusal(tmp_path, text):
    (tmp_path / "ball.yaml").write_text(yaml.safe_dump(SCENE))
    path = tmp_path / "study.yaml"
    path.write_text(HEAD + text)
    with pytest.raises(StudyError) as caught:
        load_study(str(path))
    return str(caught.value).removeprefix(str(path))


@pytest.mark.parametrize(
    ("method", "name", "expected"),
    [
        ("igs2gs", "released", {"text_guidance": 12.5, "image_guidance": 1.5, "iterations": 7500}),
        ("igs2gs", "improved", {"text_guidance": 12.5, "image_guidance": 1.5, "iterations": 3000}),
        ("dge", "released", {"text_guidance": 7.5, "image_guidance": 1.5}),
        ("gaussctrl", "paper", {"text_guidance": 5.0, "control_share": None}),
        ("gaussctrl", "released", {"text_guidance": 5.0, "control_share": 0.0}),
        ("igs2gs", None, {"text_guidance": None, "image_guidance": None}),
    ],
)
def test_a_variant_has_the_preset_of_its_method_that_it_names(method, name, expected):
    """The published numbers of docs/method/baselines.md."""
    variant = {"method": method} | ({} if name is None else {"preset": name})
    study = parse_study(
        {"name": "s", "scenes": ["bear"], "variants": {"v": variant}, "probes": {"editing": ["v"]}}
    )
    settings = edits.settings_of(study, study.variants["v"], 0)
    assert {key: settings[key] for key in expected} == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # The method's preset, or none.
        ("variants:\n  v: {method: igs2gs, preset: corrected}\nprobes: {editing: [v]}\n",
         ":5: variants.v: preset: got 'corrected', expected one of"),
        ("variants:\n  v: {method: by_view, preset: paper}\nprobes: {variability: [v]}\nseeds: [0, 1]\n",
         ":5: variants.v: preset: got 'paper', expected one of"),
        ("variants:\n  v:\n    preset: paper\n    options: {preset: extended}\nprobes: {editing: [v]}\n",
         ":6: variants.v.preset: got 'paper', which changes nothing in editing"),
        # A method without a warp.
        ("variants:\n  v: {method: dge, geometry: truth}\nprobes: {editing: [v]}\n",
         ":5: variants.v.geometry: got 'truth', which changes nothing"),
        ("variants:\n  v: {method: gaussctrl, mask: truth}\nprobes: {editing: [v]}\n",
         ":5: variants.v.mask: got 'truth', which changes nothing"),
        ("variants:\n  v: {method: true pictures, set: {depth: center}}\nprobes: {editing: [v]}\n",
         ":5: variants.v.set.depth: got 'center', which changes nothing"),
        ("variants:\n  v: {method: true pictures, options: {steps: 4}}\nprobes: {editing: [v]}\n",
         ":5: variants.v.options.steps: got 4, which changes nothing"),
        ("variants:\n  v: {method: true pictures, editor: {name: small}}\nprobes: {editing: [v]}\n",
         ":5: variants.v.editor.name: got 'small', which changes nothing"),
        ("variants:\n  v: {options: {method: each view alone, a0: 0.5}}\nprobes: {editing: [v]}\n",
         ":5: variants.v.options.a0: got 0.5, which changes nothing"),
        ("variants:\n  v: {options: {estimate_until: 0.2}}\nprobes: {editing: [v]}\n",
         ":5: variants.v.options.estimate_until: got 0.2, which changes nothing"),
        ("variants:\n  v: {method: dge, preset: released, editor: {text_guidance: 3}}\nprobes: {editing: [v]}\n",
         ":5: variants.v.editor.text_guidance: got 3.0, which changes nothing"),
        ("variants:\n  v: {options: {seed: 3}}\nprobes: {editing: [v]}\n",
         ":5: variants.v: options.seed: the seeds are the study's own"),
        ("variants:\n  v: {fit: {seed: 3}}\nprobes: {fit: [v]}\n",
         ":5: variants.v: fit.seed: the seeds are the study's own"),
        # Rules and splats.
        ("variants:\n  v:\n    set:\n      depth_agreement: false\n      depth_relative: 0.1\nprobes: {warp: [v]}\n",
         ":8: variants.v.set.depth_relative: got 0.1, which changes nothing in warp"),
        ("variants:\n  v: {set: {normal_angle: 30}}\nprobes: {warp: [v]}\n",
         ":5: variants.v.set.normal_angle: got 30, which changes nothing"),
        ("variants:\n  v: {set: {pixel_centers: integer}}\nprobes: {depth: [v], fit: [v]}\n",
         ":5: variants.v.set.pixel_centers: got 'integer', which changes nothing in depth, fit"),
        ("variants:\n  v: {geometry: truth}\nprobes: {fit: [v]}\n",
         ":5: variants.v.geometry: got 'truth', which changes nothing in fit"),
        ("variants:\n  v: {geometry: truth}\nprobes: {depth: [v]}\n",
         "probes.depth: 'v' renders nothing, so there is no depth to measure"),
        ("variants:\n  v: {geometry: truth, splats: {count: 9}}\nprobes: {warp: [v]}\n",
         ":5: variants.v.splats.count: got 9, which changes nothing"),
        ("variants:\n  v: {fitted: true, splats: {count: 9}}\nprobes: {warp: [v]}\n",
         ":5: variants.v.splats.count: got 9, which changes nothing"),
        ("variants:\n  v: {fit: {kind: 3d}}\nprobes: {timing: [v]}\n",
         ":5: variants.v.fit.kind: got '3d', which changes nothing in timing"),
        ("variants:\n  v: {by_hand: painted}\nprobes: {warp: [v]}\n",
         ":5: variants.v.by_hand: got 'painted', which changes nothing in warp"),
        ("variants:\n  v: {}\n  w: {}\nprobes: {warp: [v]}\n",
         ":6: variants.w: no probe measures it; name it under probes"),
        # Keys of the study.
        ("timing_rounds: 9\nvariants:\n  v: {}\nprobes: {warp: [v]}\n",
         ":4: timing_rounds: nothing that this study measures reads it; add audit or editing-timing"),
        ("edits: [snow]\nvariants:\n  v: {}\nprobes: {editing: [v]}\n",
         ":4: edits: nothing that this study measures reads it; add sensitivity to probes"),
        ("encoders: {clip: clip-small}\nvariants:\n  v: {}\nprobes: {variability: [v]}\nseeds: [0, 1]\n",
         ":4: encoders: nothing that this study measures reads it; add audit or editing or"),
        ("splats: {count: 9}\nvariants:\n  v: {fitted: true}\nprobes: {warp: [v]}\n",
         ":4: splats: nothing that this study measures reads it"),
        ("splats: {count: 9}\nvariants:\n  v: {splats: {count: 8}}\nprobes: {warp: [v]}\n",
         ":4: splats.count: no variant takes it from the study"),
        ("editing: {options: {steps: 9}}\nvariants:\n  v: {options: {steps: 8}}\nprobes: {editing: [v]}\n",
         ":4: editing.options.steps: no variant takes it from the study"),
        ("editing: {editor: {name: small}}\nvariants:\n  v: {editor: {}}\nprobes: {editing: [v]}\n",
         ":4: editing.editor.name: no variant takes it from the study"),
        ("fit: {settings: {iterations: 9}}\nvariants:\n  v: {}\nprobes: {warp: [v]}\n",
         ":4: fit: nothing that this study measures reads it; add fit or surfaces to probes"),
        ("stability: {levels: quick}\nvariants:\n  v: {}\nprobes: {warp: [v]}\n",
         ":4: stability: nothing that this study measures reads it; add stability to probes"),
        ("seeds: [0, 1]\nvariants:\n  v: {}\nprobes: {editing-timing: [v]}\n",
         ":4: seeds: nothing that this study measures reads it"),
        ("pictures: {variants: [v]}\nvariants:\n  v: {}\nprobes: {warp: [v]}\n",
         ":4: pictures.variants: without views no picture is saved"),
        ("pictures: {variants: [v], views: [yaw030]}\nvariants:\n  v: {}\nprobes: {timing: [v]}\n",
         ":4: pictures.variants: 'v' is measured by no probe that saves pictures"),
    ],
)  # fmt: skip
def test_what_a_study_names_and_does_not_use_is_refused_with_its_line(tmp_path, text, message):
    assert message in refusal(tmp_path, text)


def test_everything_that_is_not_used_is_named_at_once(tmp_path):
    text = "timing_rounds: 9\nvariants:\n  v: {by_hand: painted}\nprobes: {warp: [v]}\n"
    told = refusal(tmp_path, text)
    assert told.startswith(":4: timing_rounds: ") and "; line 6: variants.v.by_hand: " in told


BASE = {
    "name": "s", "scenes": ["ball.yaml"], "size": 32, "spp": 2, "seeds": [0, 1], "views": ["yaw030"],
    "feature_sizes": [16],
}  # fmt: skip
KEYS = {
    "size": 48, "spp": 3, "seeds": [0, 2], "views": ["yaw120"], "feature_sizes": [8],
    "feature_channels": 3, "timing_rounds": 4, "splats": {"count": 77}, "fit": {"views": 11},
    "encoders": {"clip": "clip-small"}, "edits": ["some_colour"],
    "editing": {"editor": {"name": "small"}}, "stability": {"levels": "quick"},
}  # fmt: skip
PLAIN = [{}, {"fitted": True}, {"geometry": "truth"}, {"method": "by_view"}]
VARIANT = {
    "preset": "released", "set.depth": "center", "set.mask_resize": "bilinear", "geometry": "truth",
    "splats.count": 77, "fit.iterations": 5, "fitted": True, "method": "by_view",
    "options.steps": 3, "options.iterations": 7, "editor.name": "small", "by_hand": "painted",
    "budget.network_rows": 9,
}  # fmt: skip


OWN = {
    "audit": {"audit": {"edit": "some_colour"}},
    "reconstruction": {"reconstruction": {"edit": "some_colour"}},
    "ideal": {"editing": {"editor": {"ideal": {"parts": 6}}}},
    "carry": {"carry": {"edits": {"ball": "make the ball red"}}},
}
"""Keys that a study of a probe has to have."""

OTHER = {"ideal": {"editing": {"editor": {"ideal": {"parts": 7}}}}}
"""Changes of keys in place of those that would take away what a probe has to have."""


def nested(key, value):
    first, _, rest = key.partition(".")
    return {first: {rest: value} if rest else value}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    edits = [*SCENE["edits"], {**SCENE["edits"][0], "name": "any_colour"}]
    (tmp_path / "ball.yaml").write_text(yaml.safe_dump({**SCENE, "edits": edits}))
    return tmp_path


def planned(name, variant, **changes):
    """The study with one probe, and the specs of its cells; None where it cannot be measured."""
    named = {"v": variant} if probe(name).judges_variants else {}
    content = {
        **BASE,
        "variants": named,
        "probes": {name: list(named)},
        **OWN.get(name, {}),
        **changes,
    }
    try:
        study = parse_study(content)
    except ValidationError:
        return None, None
    cells = cells_of(study, {scene: load_scene(scene) for scene in study.scenes})
    return study, [cell.spec for cell in cells if cell.probe == name]


@pytest.mark.parametrize("name", [p.name for p in probes() if not p.always])
def test_keys_of_a_study_are_read_by_the_probes_whose_cells_they_change(name, folder):
    read, changing = set(probe(name).study_keys), set()
    for variant in PLAIN:
        study, before = planned(name, variant)
        if study is None:
            continue
        for own in study.variants.values():
            read |= {key.partition(".")[0] for key in probe(name).reads(study, own)}
        changing |= {
            key
            for key, new in {**KEYS, **OTHER.get(name, {})}.items()
            if planned(name, variant, **{key: new})[1] != before
        }
    assert read & KEYS.keys() == changing


@pytest.mark.parametrize("name", [p.name for p in probes() if p.judges_variants])
def test_keys_of_a_variant_are_read_by_the_probes_whose_cells_they_change(name, folder):
    seen = 0
    for plain in PLAIN:
        for key, new in VARIANT.items():
            study, before = planned(name, plain)
            changed, after = planned(name, {**plain, **nested(key, new)})
            if study is None or changed is None or plain.get(key) == new:
                continue
            read = probe(name).reads(changed, changed.variants["v"])
            is_read = key in read or key.partition(".")[0] in read
            if (name, key) == ("fit", "fitted"):
                continue  # says what is so
            of_truth = name in ("warp", "labels", "surfaces") and "truth" in (
                plain.get("geometry"),
                new,
            )
            if (probe(name).edits and key == "geometry") or (of_truth and key.startswith("set.")):
                continue  # an id tells what changes nothing, too; results are compared below
            assert is_read == (before != after), (plain, key)
            seen += is_read
    assert seen


WARPS = [
    {},
    {"depth_agreement": False},
    {"normal_test": "source_incidence"},
    {"normal_test": "none", "gaussian_filter": "printed"},
    {"normal_test": "none", "gaussian_filter": "facing"},
]
OTHERS = {
    "segment": True, "depth_relative": 1e-6, "depth_slope": 1e-6, "normal_angle": 5.0,
    "depth": "center", "depth_statistic": "expected", "gaussian_filter": "printed", "opaque": 0.99,
    "pixel_centers": "integer", "mask_resize": "bilinear", "depth_interpolation": "bilinear",
    "bounds": "target", "depth_agreement": False, "photometric": 0.0, "normal_test": "none",
}  # fmt: skip


def result(view, mask=None):
    if mask is not None:
        view = view.with_mask(mask)
    layer = view.at((8, 8))
    return [view.correspondence.xy, view.mask, layer.correspondence.xy, layer.mask]


def equal(first, second):
    return all(
        torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(first, second, strict=True)
    )


@pytest.mark.parametrize("fields", WARPS)
def test_a_rule_that_is_not_read_changes_no_warp(fields, folder):
    settings = WarpSettings(**fields)
    scene = world("ball.yaml", 32)
    pair = scene.pair("yaw030", 32)
    images = {
        "source_image": scene.image(pair.source.name, 2),
        "target_image": scene.image("yaw030", 2),
    }
    model = sampled("ball.yaml", 32, 0, count=400, kind="2d", position_noise=0.1, normal_noise=3.0)
    exact = torch.from_numpy(np.ascontiguousarray(pair.visible))
    idle = dict.fromkeys(("splats", "truth", "mask"), 0)
    for name, value in OTHERS.items():
        other = dataclasses.replace(settings, **{name: value})
        of = [(s, images if s.photometric is not None else {}) for s in (settings, other)]
        splat = [
            warp_view(model, pair.source, pair.target, s, **i, warn_empty=False) for s, i in of
        ]
        truth = [warp_truth(scene, pair, s, **i) for s, i in of]
        key = f"set.{name}"
        if key not in warp_reads(settings):
            idle["splats"] += 1
            assert equal(*map(result, splat)), name
        if key not in warp_reads(settings, truth=True):
            idle["truth"] += 1
            assert equal(*map(result, truth)), name
        if key in MASK_RULES:
            idle["mask"] += 1
            assert equal(*(result(view, exact) for view in splat)), name
    assert idle["truth"] >= 4 and idle["mask"] == 7 and idle["splats"] >= 1


CHANGED = {
    "stages": 1, "views_per_stage": 1, "steps": 3, "noise": "fresh", "start_picture": "render",
    "text_guidance": 1.1, "source_text_guidance": 1.2, "batch": 1, "mask": False, "sources": 2,
    "chain_coverage": 0.9, "confidence": True, "estimate": 0.4, "estimate_until": 0.7,
    "estimate_in": "picture", "estimate_margin": 0.1, "a0": 0.5, "decay": "constant",
    "fractions": (1.0,), "kinds": ("self",), "feature_steps": (0.0, 0.5), "branches": ("text",),
    "feature_type": "float16", "composite": "black", "composite_blur": 2.0, "iterations": 2,
    "training": "stage", "l1": 0.3, "perceptual": 0.2, "normal": 0.3, "distortion": 0.3,
    "color_rate": 1.0, "geometry_rate": 0.0, "background": "white", "psnr_views": "before_last_stage",
    "warp.bounds": "target", "warp.depth_agreement": False, "warp.normal_test": "none",
    "warp.in_front": False, "warp.pixel_centers": "integer", "warp.mask_resize": "bilinear",
    "warp.depth_relative": 1e-6, "warp.normal_angle": 5.0, "warp.gaussian_filter": "printed",
}  # fmt: skip
QUICK = {"stages": 2, "views_per_stage": 2, "steps": 2, "iterations": 1}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "own"),
    [
        ("attention_warping", {}),
        ("attention_warping", {"method": "each view alone"}),
        ("attention_warping", {"method": "each view alone", "estimate": 0.5}),
        ("attention_warping", {"mask": False}),
        ("attention_warping", {"iterations": 0}),
        ("true pictures", {}),
        ("true pictures", {"sources": 2}),
    ],
)
def test_options_that_are_not_read_change_no_byte_of_an_edit(method, own, tmp_path):
    """All of them at once, and each that is read is one that the test would see or an exact tie."""
    model, views = splats(), cameras(5)
    images = pictures(model, views)
    truth = {"red": [1 - image for image in images]}
    editor = load_editor("small-plain")
    described = EDITING_METHODS[method]

    def run(place, **fields):
        settings = described.settings(None, {**QUICK, **own, **fields}, 0)
        folder = tmp_path / place
        folder.mkdir()
        job = Job(model, views, images, editor, "make it red", settings, folder, None, truth)
        done = described.run(job)
        return settings, [
            done.gaussians.digest(),
            *(done.edited[k].tobytes() for k in sorted(done.edited)),
        ]

    settings, plain = run("plain")
    read = described.reads(settings)
    idle = {
        key: new for key, new in CHANGED.items() if f"options.{key}" not in read and key not in own
    }
    assert len(idle) >= 6
    assert run("idle", **idle)[1] == plain
