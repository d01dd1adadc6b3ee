"""Labels rank warps as the ideal editor does; each is the other's oracle, since they share no code behind the warp."""

import numpy as np
import pytest
from scipy.stats import spearmanr
from torch_threads import on_one_thread

from attnwarp.methods import attention_warping
from attnwarp.methods import preset as method_preset
from attnwarp.warp import preset, warp_view
from attnwarp_eval.study.shared.controls import MovedView
from attnwarp_eval.study.shared.warps import warp_truth
from attnwarp_eval.two_view import HIDDEN
from attnwarp_eval.world import splats, world
from attnwarp_lab.ideal.figures import part_answers, part_figures
from attnwarp_lab.ideal.labels import carried_labels, label_transport
from attnwarp_lab.ideal.parts import token_parts
from attnwarp_lab.ideal.share import solve_share
from attnwarp_lab.ideal.thing import Thing, in_front

SIZE, GRID, PARTS = 128, 32, 12
VIEWS = ["source", "yaw010", "yaw030", "yaw045", "yaw060"]
BOUNDS = {"in_front": False, "opaque": None, "depth_agreement": False, "normal_test": "none"}

one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


def warps(scene):
    """Functions of an exact pair of views, by name."""
    of = world(scene, SIZE)
    exact = preset("corrected", depth_relative=1e-4, depth_spread=0.02)

    def along(count, kind="2d", noise=0.1, turn=3.0, **changes):
        model = splats(
            scene, SIZE, 0, kind=kind, count=count, position_noise=noise, normal_noise=turn
        )
        settings = preset("corrected", **changes)
        return lambda pair: warp_view(model, pair.source, pair.target, settings, warn_empty=False)

    def wrong(*control):
        return lambda pair: MovedView.of(warp_truth(of, pair, exact), *control)

    return {
        "exact": lambda pair: warp_truth(of, pair, exact),
        "16k splats": along(16000), "4k splats": along(4000), "1k splats": along(1000),
        "300 splats": along(300), "1k splats, 3D": along(1000, "3d"),
        "16k splats, bounds only": along(16000, **BOUNDS), "1k splats, bounds only": along(1000, **BOUNDS),
        "noisy splats": along(4000, noise=2.0, turn=20.0), "photometric": along(16000, photometric=0.05),
        "mirrored": wrong("mirrored"), "displaced by 1/8": wrong("displaced"),
        "displaced by 1/16": wrong("displaced", 1 / 16), "displaced by 1/32": wrong("displaced", 1 / 32),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "objects"),
    [
        ("spheres", ["melon", "marble", "beach_ball", "planet", "stone", "bubble"]),
        ("bear", ["bear"]),
    ],
)
def test_labels_rank_warps_as_the_ideal_editor_does(scene, objects):
    of = world(scene, SIZE)
    cameras = [of.camera(name) for name in VIEWS]
    thing = Thing.of(of.scene, of.geometry, cameras, objects, parts=PARTS, colors=4, spp=2)
    editor = thing.editor(solve_share(thing.grams, 0.4, 8))
    model = splats(scene, SIZE, 0, kind="2d", count=300, position_noise=0.0, normal_noise=0.0)
    truth = {name: thing.truth(name) for name in VIEWS}
    tokens = {name: token_parts(thing.labels[name], (GRID, GRID)) for name in VIEWS}
    images = [thing.before[name] for name in VIEWS]
    right, seen = [], []
    for make in warps(scene).values():
        made = {k: make(of.pair(name, SIZE)) for k, name in enumerate(VIEWS) if k}
        labels, shown = [], []
        for k, name in enumerate(VIEWS[1:], 1):
            pair = of.pair(name, SIZE)
            carried = carried_labels(made[k].at((GRID, GRID)), tokens["source"])
            figures = label_transport(
                carried, tokens[name], thing.labels[name], pair.visible, pair.unseen
            )
            labels.append(figures["labels.right"])
        for seed in range(4):
            settings = method_preset(
                "attention_warping",
                stages=1,
                steps=8,
                iterations=0,
                noise="fresh",
                decay="constant",
                seed=seed,
            )
            result = attention_warping(
                model,
                cameras,
                images,
                editor,
                "paint",
                settings,
                warps=lambda _, target, made=made: made[target],
            )
            edited = {VIEWS[k]: image / np.float32(255) for k, image in result.edited.items()}
            answers = part_answers(edited["source"], truth["source"], PARTS)
            for name in VIEWS[1:]:
                pair = of.pair(name, SIZE)
                figures = part_figures(
                    edited[name], truth[name], answers, pair.visible, pair.label == HIDDEN,
                    in_front(pair, thing.labels["source"]),
                )  # fmt: skip
                shown.append(figures["parts.seen"])
        right.append(np.nanmean(labels))
        seen.append(np.nanmean(shown))
    assert len(right) >= 11
    assert spearmanr(right, seen).statistic >= 0.9, (right, seen)
