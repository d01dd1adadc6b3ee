"""Oracles: what Python's pickles hold."""

import pickle

import pytest
import torch
from tiny_models import save_backbone

from attnwarp.encoders import load_encoder
from attnwarp.encoders._weights import state_of
from attnwarp.encoders.lpips import BACKBONES
from attnwarp.errors import InputError

ADVICE = ("weights_only", "trust", "torch.load", "allowlist", "safe_globals")


class Evil:
    def __reduce__(self):
        return (print, ("ran",))


def test_objects_that_could_run_code_are_refused_without_advice_to_run_them(tmp_path, capfd):
    for name, obj in (("evil.pth", {"w": Evil()}), ("class.pt", torch.nn.Linear(1, 1))):
        torch.save(obj, tmp_path / name)
        with pytest.raises(
            InputError, match=f"{name}: cannot be read as weights .*run code"
        ) as got:
            state_of(tmp_path / name)
        assert not any(advice in str(got.value) for advice in ADVICE)
    (tmp_path / "plain.bin").write_bytes(pickle.dumps({"w": Evil()}))
    with pytest.raises(InputError, match="plain.bin: cannot be read as weights") as got:
        state_of(tmp_path / "plain.bin")
    assert not any(advice in str(got.value) for advice in ADVICE)
    assert "ran" not in capfd.readouterr().out


@pytest.mark.door
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.99])
def test_a_cut_file_of_lpips_is_named(kept, tmp_path):
    path = tmp_path / BACKBONES["alex"].file
    save_backbone(path, "alex")
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=f"{path.name}: cannot be read as weights"):
        load_encoder(f"lpips:{tmp_path}", "perceptual")
