"""Oracles: the losses that an epoch gave."""

import pytest
import torch

from training.common import Run
from training.log import log_path, read_log


def run(path, epochs, *, stop_in=None, every=0.0):
    """Losses 1/1, 1/2, ...; the checkpoint after an epoch holds its number."""
    net = torch.nn.Linear(1, 1)

    def epoch(number):
        if number == stop_in:
            raise KeyboardInterrupt
        return {"loss": 1 / (number + 1)}

    Run(path, {"net": net}, epochs, {"EPOCHS": epochs}, every=every, steps=100).train(epoch)


def test_a_resumed_training_has_one_line_for_each_epoch_and_none_that_was_lost(tmp_path):
    checkpoint = tmp_path / "new folder" / "plain.pt"
    # No checkpoint for 1,000 s: the three epochs are lost and taken again.
    with pytest.raises(KeyboardInterrupt):
        run(checkpoint, 5, stop_in=3, every=1000)
    assert not checkpoint.exists() and len(read_log(log_path(checkpoint))) == 3
    with pytest.raises(KeyboardInterrupt):
        run(checkpoint, 5, stop_in=4)
    log = log_path(checkpoint)
    log.write_text(log.read_text() + '{"stage": "plain", "ep')  # as a kill in a write leaves it
    run(checkpoint, 5)
    entries = read_log(log)
    assert [(e.epoch, e.steps) for e in entries] == [(k, 100 * k) for k in range(1, 6)]
    assert [e.losses for e in entries] == [{"loss": 1 / k} for k in range(1, 6)]
    seconds = [e.seconds for e in entries]
    assert seconds == sorted(seconds)
    assert seconds[-1] == torch.load(checkpoint, weights_only=True)["seconds"]


def test_a_training_stopped_in_its_first_epoch_has_no_log(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "plain.pt", 2, stop_in=0)
    assert not log_path(tmp_path / "plain.pt").exists()
    finished = tmp_path / "control.pt"  # from before logs were written
    run(finished, 1)
    log_path(finished).unlink()
    run(finished, 1)
    assert not log_path(finished).exists()
