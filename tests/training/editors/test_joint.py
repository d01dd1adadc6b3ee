"""The recipe of a small editor of joint attention. Oracles: the flow written out, a run that was not stopped."""

from dataclasses import replace

import pytest
import torch
from small_trainings import draw_pairs, stopped_at

from training import steps
from training.editors import recipe
from training.editors.joint import JOINT_STAGES, JointNet
from training.editors.net import scheduler
from training.editors.pool import PairPool
from training.editors.recipe import make_tokenizer, train_stage
from training.worlds.editing_pairs import load_pairs

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")


def test_it_is_small_and_predicts_the_clean_end_of_a_flow():
    torch.manual_seed(0)
    net = JointNet(1500).eval()
    assert sum(p.numel() for p in net.parameters()) < 6_000_000
    clean, noise, before = torch.randn(3, 2, 48, 4, 6).unbind(0)
    tokens, t = torch.randint(2, 1500, (2, 24)), torch.tensor([999, 400])
    a = scheduler(16.0).alphas_cumprod[t].double()
    share = (1 - a).sqrt() / (a.sqrt() + (1 - a).sqrt())
    assert share[0] == 1  # the last step is noise alone
    assert torch.allclose((share / (1 - share))[1] ** 2, ((1 - a) / a)[1])
    shape = (2, 1, 1, 1)
    noisy = a.sqrt().view(shape) * clean + (1 - a).sqrt().view(shape) * noise
    flow = (1 - share.view(shape)) * clean + share.view(shape) * noise
    with torch.no_grad():
        found = net(noisy.float(), before, t, tokens)
        seen = {}
        handle = net.transformer.register_forward_hook(
            lambda m, a, k, out: seen.update(k, out=out[0]), with_kwargs=True
        )
        net(noisy.float(), before, t, tokens)
        handle.remove()
    rows = flow.flatten(2).transpose(1, 2)
    assert torch.allclose(seen["hidden_states"][:, :24].double(), rows, atol=1e-5)
    assert torch.equal(seen["hidden_states"][:, 24:], before.flatten(2).transpose(1, 2))
    assert torch.allclose(seen["timestep"].double(), share, atol=1e-6)
    velocity = seen["out"][:, :24].transpose(1, 2).unflatten(2, (4, 6)).double()
    assert torch.allclose(found.double(), flow - share.view(shape) * velocity, atol=1e-5)


@pytest.mark.slow
def test_a_stopped_training_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    draw_pairs(tmp_path)
    words = make_tokenizer(400, worlds=10)
    pool = PairPool(load_pairs(tmp_path, "edit-train", count=2), words, sentences=4)
    monkeypatch.setattr(steps, "STEPS_AN_EPOCH", 1)
    monkeypatch.setattr(steps, "SAVE_SECONDS", 0)
    stage = replace(JOINT_STAGES["joint"], steps=3, batch=2, worlds=2, parts=0, large=0.0)
    found = []
    for name in ("whole", "cut"):
        out = tmp_path / name
        out.mkdir()
        words.save(str(out / "tokenizer.json"))
        if name == "cut":
            with stopped_at(steps.Stepper, "step", 2):
                train_stage("joint", tmp_path, out, stage=stage, pool=pool)
        train_stage("joint", tmp_path, out, stage=stage, pool=pool)
        found.append(recipe.weights_of(out, "joint"))
    assert all(torch.equal(value, found[1][key]) for key, value in found[0].items())
