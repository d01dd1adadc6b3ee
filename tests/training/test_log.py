"""Oracles: the losses that an epoch gave, means worked out by hand."""

import pytest
import torch
from typer.testing import CliRunner

from training.common import Run
from training.editors.__main__ import app
from training.log import Entry, append, log_path, read_log, table


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


def test_the_table_has_what_each_stage_took_and_the_mean_of_its_last_losses(tmp_path):
    path = log_path(tmp_path / "drawn.pt")
    for k in range(1, 21):
        losses = {"loss 0": 20.0 - k} | ({"loss 1": 0.25} if k == 15 else {})
        append(path, Entry("drawn", k, 100 * k, 30 + 2.5 * k, losses))
    # Epochs 11 to 20: the mean of 9, 8, ..., 0. 2.5 s an epoch of 100 steps.
    assert table([path]).splitlines()[2:] == [
        "| `drawn` | 2,000 | 80 | 25.0 | loss 0 4.5000, loss 1 0.2500 |"
    ]
    printed = CliRunner().invoke(app, ["stages", "--out", str(tmp_path)])
    assert printed.exit_code == 0 and printed.stdout.strip() == table([path])


@pytest.mark.door
def test_a_folder_without_a_log_is_refused_by_name(tmp_path):
    result = CliRunner().invoke(app, ["stages", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "no log of an epoch" in " ".join(result.output.replace("│", " ").split())


def test_a_training_stopped_in_its_first_epoch_has_no_row(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "plain.pt", 2, stop_in=0)
    assert not log_path(tmp_path / "plain.pt").exists()
    # As a resumed training of lost epochs, or former code, leaves it.
    log_path(tmp_path / "features.pt").write_text("")
    assert CliRunner().invoke(app, ["stages", "--out", str(tmp_path)]).exit_code == 2
    run(tmp_path / "drawn.pt", 1)
    printed = CliRunner().invoke(app, ["stages", "--out", str(tmp_path)])
    rows = printed.stdout.strip().splitlines()[2:]
    assert printed.exit_code == 0 and len(rows) == 1 and rows[0].startswith("| `drawn` | 100 |")
    finished = tmp_path / "control.pt"  # from before logs were written
    run(finished, 1)
    log_path(finished).unlink()
    run(finished, 1)
    assert not log_path(finished).exists()
