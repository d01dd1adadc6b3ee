"""Variants on fitted splats. Oracle: the run's own file of splats, rendered by the float64 definition."""

import numpy as np
import pytest
import torch
import yaml
from ball_scene import SCENE

from attnwarp.io import read_ply
from attnwarp.render import render
from attnwarp_eval.inspect import subject
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.study import Store, cells_of, load_study, parse_study
from attnwarp_eval.study.probe import probe
from attnwarp_eval.study.run import execute, plan
from attnwarp_eval.study.shared.fits import folder_of
from attnwarp_eval.world import world

FIT = {"views": 9, "points": 60, "settings": {"iterations": 4, "evaluate_every": 4}}
STUDY = {
    "name": "fitted",
    "size": 32,
    "scenes": ["ball.yaml"],
    "spp": 2,
    "splats": {"count": 300},
    "fit": FIT,
    "variants": {
        "sampled": {},
        "2D": {"fitted": True},
        "3D": {"fitted": True, "fit": {"kind": "3d"}},
        "own fit, sampled splats": {"fit": {"kind": "3d"}},
    },
}


def load(folder, **probes):
    named = {name for names in probes.values() for name in names}
    variants = {name: STUDY["variants"][name] for name in sorted(named)}
    content = {**STUDY, "variants": variants, "probes": probes}
    (folder / "fitted.yaml").write_text(yaml.safe_dump(content))
    return load_study(str(folder / "fitted.yaml"))


@pytest.fixture
def folder(tmp_path, coarse_textures, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.yaml").write_text(yaml.safe_dump(SCENE))
    return tmp_path


def test_probes_share_one_fit_and_its_depth_is_what_they_measure(folder):
    study = load(folder, depth=["sampled", "2D"], warp=["2D"], timing=["sampled", "2D"])
    store = Store(folder / "run")
    assert execute(plan(study, store), store).complete
    (file,) = (store.root / "fits").glob("*/splats.ply")  # the three cells share one fit
    splats = read_ply(file)
    # The cell that times both variants says nothing of their splats.
    shown = subject.of_run(store.root)
    assert torch.equal(shown.pair("2D", shown.targets[0]).model.means, splats.means)
    assert len(shown.pair("sampled", shown.targets[0]).model) == 300
    scene = world(study.scenes[0], 32)
    records = {
        (cell["probe"], *cell["variants"]): store.read(cell["id"])
        for cell in store.read_study()["cells"]
    }
    for view in records["depth", "2D"]["views"]:
        camera = scene.targets[view["view"]]
        drawn = render(splats.to(dtype=torch.float64), camera, backend="reference")
        depth = drawn.median_depth.numpy()
        truth = scene.pair(view["view"], 32).hits
        both = truth.valid & (depth > 0) & np.isfinite(depth)
        error = np.mean(np.abs(depth - truth.depth)[both] / truth.depth[both])
        assert view["metrics"]["depth.abs_rel"] == pytest.approx(error, rel=1e-3)


def test_a_variant_takes_its_own_kind_of_fit_and_none_where_it_does_not_say_fitted(folder):
    study = load(folder, warp=list(STUDY["variants"]), fit=["own fit, sampled splats"])
    cells = cells_of(study, {name: load_scene(name) for name in study.scenes})
    specs = {name: cell.spec for cell in cells if cell.probe == "warp" for name in cell.labels}
    assert specs["2D"]["fit"]["settings"]["kind"] == "2d"
    assert specs["3D"]["fit"]["settings"]["kind"] == "3d"
    # A sampled variant's cell is the same as ever, whatever fit it names for other probes.
    assert specs["own fit, sampled splats"] == specs["sampled"]
    assert specs["sampled"]["splats"]["count"] == 300
    assert "fit" not in specs["sampled"]


@pytest.mark.parametrize("name", ["warp", "depth", "editing"])
def test_claims_tell_fitted_splats_from_sampled_and_2d_from_3d(name):
    study = parse_study({**STUDY, "scenes": ["spheres"], "probes": {"depth": ["sampled"]}})
    of = probe(name)
    kinds = [study.variants[label] for label in ("sampled", "2D", "3D")]
    meant = [of.meaning(study, one) for one in kinds]
    alike = [[one == two for two in meant] for one in meant]
    assert alike == np.eye(3, dtype=bool).tolist()


def test_all_seeds_of_a_study_share_a_fit_whose_seed_it_gives(folder):
    fits, noise = {}, set()
    for own in ({}, {"seed": 0}):
        content = {**STUDY, "fit": {**FIT, **own}, "seeds": [0, 1], "probes": {"warp": ["2D"]}}
        study = parse_study(content)
        cells = cells_of(study, {name: load_scene(name) for name in study.scenes})
        specs = [cell.spec for cell in cells if cell.probe == "warp"]
        fits[bool(own)] = [str(folder_of(folder, spec)) for spec in specs]
        noise |= {spec["seed"] for spec in specs}
    assert len(set(fits[False])) == 2 and noise == {0, 1}
    assert fits[True] == fits[False][:1] * 2
