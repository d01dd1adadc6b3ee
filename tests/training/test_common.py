"""A run that is stopped and gone on with, to the bit; and what it must not be gone on with."""

import json
import re

import numpy as np
import pytest
import torch

from attnwarp.errors import InputError
from training import common
from training.common import Run, minutes, rate, settings
from training.encoders import clip, dino, naming, perceptual
from training.worlds.data import DATA_PROTOCOL, SPLITS

STEPS = 5


class Small:
    """A linear model taught by AdamW, a fresh one each time; its start is drawn from ``seed``."""

    def __init__(
        self, path, *, epochs=2, seed=0, stop_in=None, keep=("model", "optimizer"), recipe=None
    ):
        torch.manual_seed(seed)
        self.model = torch.nn.Linear(7, 3)
        self.optimizer = torch.optim.AdamW(self.model.parameters(), lr=0.1, weight_decay=0.05)
        state = {"model": self.model, "optimizer": self.optimizer}
        self.epochs, self.stop_in, self.ran = epochs, stop_in, []
        self.run = Run(
            path,
            {name: state[name] for name in keep},
            epochs,
            recipe or {"PEAK": 0.1, "WORDS": ("a", "b")},
        )

    def epoch(self, number):
        if number == self.stop_in:
            raise KeyboardInterrupt
        self.ran.append(number)
        rng = np.random.default_rng([3, number])
        for step in range(STEPS):
            for group in self.optimizer.param_groups:
                group["lr"] = rate(number * STEPS + step, self.epochs * STEPS, 0.1, 2)
            x, y = (torch.from_numpy(rng.normal(size=(16, k))).float() for k in (7, 3))
            loss = (self.model(x) - y).abs().mean()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        return {"loss": float(loss.detach())}

    def train(self):
        self.run.train(self.epoch)
        return self

    def bits(self):
        return [p.detach().numpy().tobytes() for p in self.model.parameters()]


def stopped(path, **how):
    with pytest.raises(KeyboardInterrupt):
        Small(path, stop_in=1, **how).train()


def test_a_run_that_was_stopped_gives_the_bits_of_one_that_was_not(tmp_path):
    whole = Small(tmp_path / "whole.pt").train()
    stopped(tmp_path / "halves.pt")
    resumed = Small(tmp_path / "halves.pt", seed=99).train()  # its own start does not matter
    assert (whole.ran, resumed.ran) == ([0, 1], [1])
    assert resumed.bits() == whole.bits()
    one, other = (
        torch.load(tmp_path / f"{name}.pt", weights_only=True) for name in ("whole", "halves")
    )
    moments = [
        [s["exp_avg"].tolist() for s in stored["optimizer"]["state"].values()]
        for stored in (one, other)
    ]
    assert moments[0] == moments[1]
    assert not list(tmp_path.glob("*.tmp"))


def test_a_finished_run_is_read_and_not_run(tmp_path):
    done = Small(tmp_path / "a.pt").train()
    again = Small(tmp_path / "a.pt", seed=5).train()
    assert again.ran == [] and again.bits() == done.bits()


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"epochs": 3}, "was made with epochs = 2, got 3"),
        ({"recipe": {"PEAK": 0.2, "WORDS": ("a", "b")}}, "was made with PEAK = 0.1, got 0.2"),
        (
            {"recipe": {"PEAK": 0.1, "WORDS": ("b", "a")}},
            'was made with WORDS = ["a", "b"], got ["b", "a"]',
        ),
        ({"recipe": {"PEAK": 0.1}}, 'was made with WORDS = ["a", "b"], got nothing'),
        (
            {"recipe": {"PEAK": 0.1, "WORDS": ("a", "b"), "NEW": None}},
            "was made with NEW = nothing, got null",
        ),
    ],
)
def test_another_recipe_is_refused_and_the_setting_named(tmp_path, how, said):
    stopped(tmp_path / "a.pt")
    before = (tmp_path / "a.pt").read_bytes()
    other = Small(tmp_path / "a.pt", **how)
    remedy = "; remove it to train from the start, or restore the setting"
    with pytest.raises(InputError, match=re.escape(f"{tmp_path / 'a.pt'}: {said}{remedy}")):
        other.train()
    assert other.ran == [] and (tmp_path / "a.pt").read_bytes() == before


def test_a_checkpoint_that_names_no_recipe_is_refused(tmp_path):
    stopped(tmp_path / "a.pt")
    stored = torch.load(tmp_path / "a.pt", weights_only=True)
    torch.save(
        {k: v for k, v in stored.items() if k not in ("recipe", "seconds")}, tmp_path / "a.pt"
    )
    with pytest.raises(
        InputError, match=r"a\.pt: does not say which recipe it was made by.*; remove it"
    ):
        Small(tmp_path / "a.pt").train()
    assert minutes(tmp_path / "a.pt") is None


def test_the_seconds_of_both_halves_are_added(tmp_path, monkeypatch):
    clock = iter(
        [10, 40, 100, 100, 150]
    )  # epochs of 30 s, then one begun and stopped; resumed, one of 50 s
    monkeypatch.setattr(common.time, "perf_counter", lambda: next(clock))
    stopped(tmp_path / "a.pt")
    assert minutes(tmp_path / "a.pt") == 0.5
    Small(tmp_path / "a.pt").train()
    assert minutes(tmp_path / "a.pt") == pytest.approx(80 / 60)
    assert minutes(tmp_path / "a.pt", tmp_path / "none.pt") is None
    assert minutes(tmp_path / "a.pt", tmp_path / "a.pt") == pytest.approx(160 / 60)


def test_seconds_before_the_first_epoch_are_counted_once(tmp_path, monkeypatch):
    clock = iter([10, 40, 100, 100, 150])
    monkeypatch.setattr(common.time, "perf_counter", lambda: next(clock))
    small = Small(tmp_path / "a.pt", stop_in=1)
    small.run.spent = 15.0
    with pytest.raises(KeyboardInterrupt):
        small.train()
    assert minutes(tmp_path / "a.pt") == 0.75
    resumed = Small(tmp_path / "a.pt")
    resumed.run.spent = 15.0  # the layers that learned first are in the checkpoint
    resumed.train()
    assert minutes(tmp_path / "a.pt") == pytest.approx(95 / 60)


def test_what_a_recipe_says_is_its_constants_its_words_and_its_pictures():
    said = settings(vars(dino), "train")
    assert (said["EPOCHS"], said["PEAK"], said["SEED"]) == (dino.EPOCHS, dino.PEAK, dino.SEED)
    assert not {"F", "Run", "np", "Tensor"} & set(said)
    assert (
        said["data"]["protocol"] == DATA_PROTOCOL
        and said["data"]["train"]["worlds"] == SPLITS["train"].worlds
    )
    assert "COLORS" in settings(vars(clip)) and "TRAIN_KINDS" in settings(vars(perceptual))
    for module in (clip, naming, dino, perceptual):
        assert json.loads(json.dumps(settings(vars(module))))["SEED"] == module.SEED
    assert set(naming.recipe()["data"]) == {
        "protocol",
        "train",
        "train-rendered",
        "train-moved",
        "train-shapes",
    }


def test_a_checkpoint_without_a_recipe_is_still_exported(tmp_path):
    from safetensors.torch import load_file

    from training.encoders.__main__ import export

    state = {"weight": torch.randn(4, 3), "count": torch.tensor([7])}
    torch.save({"model": state, "epoch": 6}, tmp_path / "perceptual-small.pt")
    export("perceptual-small", tmp_path, tmp_path / "weights")
    written = load_file(tmp_path / "weights" / "perceptual-small.safetensors")
    assert written["weight"].dtype == torch.float16 and torch.equal(
        written["weight"], state["weight"].half()
    )
    assert torch.equal(written["count"], state["count"])
