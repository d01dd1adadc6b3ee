"""LPIPS with torchvision's layouts and the published linear layers, held against torchmetrics and
against a sum by hand.
"""

import numpy as np
import pytest
import tiny_models
import torch
from torch import nn
from torch_threads import on_one_thread

from attnwarp.encoders import PerceptualDistance, load_encoder
from attnwarp.encoders.lpips import BACKBONES, SCALE, SHIFT, features
from attnwarp.errors import InputError

CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


@pytest.fixture(scope="module", params=["alex", "vgg"])
def placed(request, tmp_path_factory):
    """A folder with a random backbone and both published files of linear layers; the network;
    its name.
    """
    folder = tmp_path_factory.mktemp(request.param)
    network = tiny_models.save_backbone(folder / BACKBONES[request.param].file, request.param)
    for name in CHANNELS:
        (folder / f"{name}.pth").write_bytes(
            (tiny_models.linear_layers() / f"{name}.pth").read_bytes()
        )
    (folder / f"._{BACKBONES[request.param].file}").write_bytes(b"\0\5\x16\7")  # of macOS
    return folder, network, request.param


def pictures(*sizes, seed=0):
    random = np.random.default_rng(seed)
    return [random.random((*size, 3), dtype=np.float32) for size in sizes]


SIZES = ((40, 40), (33, 48))


def test_it_is_torchmetrics_network(placed, monkeypatch):
    from torchmetrics.functional.image import lpips

    folder, network, name = placed
    monkeypatch.setattr(lpips, "_get_tv_model_features", lambda net, pretrained=False: network)
    judge = lpips._LPIPS(pretrained=True, net=name, pnet_rand=False, eval_mode=True)
    encoder = load_encoder(f"lpips:{folder}", "perceptual")
    a, b = pictures(*SIZES), pictures(*SIZES, seed=1)
    got = encoder.distance(a, b)
    assert isinstance(encoder, PerceptualDistance) and got.dtype == np.float64
    for x, y, value in zip(a, b, got, strict=True):
        x, y = (torch.from_numpy(v).permute(2, 0, 1)[None] for v in (x, y))
        with torch.no_grad():
            expected = float(judge(x, y, normalize=True))
        # torchmetrics adds 1e-8 to the square of a feature's length, the authors 1e-10 to the
        # length: random networks' features are long enough (above 1e-2) for that to change the
        # fourth digit at most.
        assert value == pytest.approx(expected, rel=1e-3)
        assert value > 1e-3


def test_its_loss_is_its_distance_and_has_a_slope(placed):
    encoder = load_encoder(f"lpips:{placed[0]}", "perceptual")
    (a,), (b,) = pictures((36, 40)), pictures((36, 40), seed=1)
    image = torch.from_numpy(a).requires_grad_(True)
    loss = encoder.loss(image, torch.from_numpy(b))
    assert float(loss.detach()) == pytest.approx(encoder.distance([a], [b])[0], rel=1e-5)
    (slope,) = torch.autograd.grad(loss, image)
    nearer = image.detach() - 1e-3 * slope / slope.norm()
    fallen = float(encoder.loss(nearer, torch.from_numpy(b)) - loss.detach())
    assert fallen == pytest.approx(-1e-3 * float(slope.norm()), rel=0.1)


def test_it_is_the_sum_of_the_paper_in_float64(placed):
    folder, network, name = placed
    state = torch.load(folder / f"{name}.pth", map_location="cpu", weights_only=True)
    (a,), (b,) = pictures((36, 40)), pictures((36, 40), seed=1)
    judge, total = network.double(), 0.0
    x, y = ((2 * v.astype(np.float64) - 1 - np.array(SHIFT)) / np.array(SCALE) for v in (a, b))
    x, y = (torch.from_numpy(v).permute(2, 0, 1)[None] for v in (x, y))
    stage = 0
    with torch.no_grad():
        for i, layer in enumerate(judge):
            if stage == len(CHANNELS[name]):
                break  # a last pool, which nothing is read behind
            x, y = layer(x), layer(y)
            following = judge[i + 1] if i + 1 < len(judge) else None
            if isinstance(layer, nn.Conv2d | nn.MaxPool2d) or (
                name == "vgg" and isinstance(following, nn.Conv2d)
            ):
                continue  # stages end at a rectified output: each of them, or VGG's last before each pool
            w = state[f"lin{stage}.model.1.weight"].double().flatten().numpy()
            u, v = (f[0].numpy() / (np.sqrt((f[0].numpy() ** 2).sum(0)) + 1e-10) for f in (x, y))
            total += (w[:, None, None] * (u - v) ** 2).sum(0).mean()
            stage += 1
    network.float()
    assert stage == len(CHANNELS[name])
    assert load_encoder(f"lpips:{folder}").distance([a], [b])[0] == pytest.approx(
        total, rel=1e-5
    )  # float32


def test_equal_pictures_are_at_0_and_the_order_does_not_matter(placed):
    encoder = load_encoder(f"lpips:{placed[0]}")
    a, b = pictures(*SIZES), pictures(*SIZES, seed=1)
    assert (encoder.distance(a, a) == 0).all()
    np.testing.assert_allclose(encoder.distance(a, b), encoder.distance(b, a), rtol=1e-6)
    assert encoder.distance([], []).shape == (0,)


def test_the_smallest_picture_goes_through_and_a_smaller_one_is_refused(placed):
    side = BACKBONES[placed[2]].smallest
    encoder = load_encoder(f"lpips:{placed[0]}")
    assert np.isfinite(
        encoder.distance(pictures((side, side)), pictures((side, side), seed=1))
    ).all()
    with pytest.raises(
        ValueError,
        match=rf"a\[0\]: got {side} x {side - 1} px, expected sides of at least {side} px",
    ):
        encoder.distance(pictures((side - 1, side)), pictures((side - 1, side)))
    with torch.no_grad(), pytest.raises(RuntimeError):  # the limit is the network's, not ours
        tiny_models.torchvision_features(tiny_models.TORCHVISION[placed[2]])[
            : BACKBONES[placed[2]].taps[-1] + 1
        ](torch.zeros(1, 3, side - 1, side))


def test_a_file_saved_from_the_lpips_package_is_one_that_holds_all(placed, tmp_path):
    folder, network, name = placed
    taps = BACKBONES[name].taps
    state = {
        "scaling_layer.shift": torch.zeros(1, 3, 1, 1),
        "scaling_layer.scale": torch.ones(1, 3, 1, 1),
    }
    for key, value in network.state_dict().items():
        number = 1 + sum(int(key.split(".")[0]) > tap for tap in taps)
        state[f"net.slice{number}.{key}"] = value
    linear = torch.load(folder / f"{name}.pth", map_location="cpu", weights_only=True)
    # The package keeps each linear layer twice, as an attribute and in a list.
    state |= linear | {key.replace("lin", "lins.", 1): value for key, value in linear.items()}
    torch.save(state, tmp_path / "whole.pth")
    a, b = pictures(*SIZES), pictures(*SIZES, seed=1)
    whole = load_encoder(f"lpips:{tmp_path / 'whole.pth'}")
    assert np.array_equal(whole.distance(a, b), load_encoder(f"lpips:{folder}").distance(a, b))
    assert whole.about.source == str(tmp_path / "whole.pth") and whole.about.size is None
    assert f"LPIPS 0.1 with {name}: [0, 1] to [-1, 1]" in whole.about.preprocessing


def test_the_layers_bear_torchvision_s_names():
    for name, channels in CHANNELS.items():
        taps = BACKBONES[name].taps
        judge = tiny_models.torchvision_features(tiny_models.TORCHVISION[name])
        ours = {key: tuple(value.shape) for key, value in features(name).state_dict().items()}
        assert ours == {key: tuple(value.shape) for key, value in judge.state_dict().items()}
        x = torch.zeros(1, 3, 64, 64)
        for i, layer in enumerate(judge):
            x = layer(x)
            if i in taps:
                assert x.shape[1] == channels[taps.index(i)]


@pytest.mark.door
def test_what_is_missing_is_named_with_the_remedy(placed, tmp_path):
    folder, _, name = placed
    backbone = BACKBONES[name].file
    with pytest.raises(
        InputError,
        match=r"is no file and no folder with weights\. Place there two files.*torchvision",
    ):
        load_encoder(f"lpips:{tmp_path / 'nowhere'}")
    (tmp_path / backbone).write_bytes((folder / backbone).read_bytes())
    with pytest.raises(InputError, match=f"holds no linear layers for {name}, expected one file"):
        load_encoder(f"lpips:{tmp_path}")
    (tmp_path / "again.pth").write_bytes((folder / backbone).read_bytes())
    with pytest.raises(InputError, match="several backbones: again.pth, "):
        load_encoder(f"lpips:{tmp_path}")
    with pytest.raises(InputError, match=r"alex\.pth holds no backbone"):
        load_encoder(f"lpips:{tiny_models.linear_layers() / 'alex.pth'}")
    (tmp_path / "again.pth").write_bytes(b"no weights")
    with pytest.raises(InputError, match=r"again\.pth: cannot be read as weights"):
        load_encoder(f"lpips:{tmp_path}")


@pytest.mark.door
def test_pairs_that_do_not_fit_are_named(tmp_path_factory, placed):
    encoder = load_encoder(f"lpips:{placed[0]}")
    with pytest.raises(ValueError, match="b: got 2 pictures, expected 1, as a"):
        encoder.distance(pictures((36, 36)), pictures((36, 36), (36, 36)))
    with pytest.raises(ValueError, match=r"b\[0\]: got 40 x 36 px, expected 36 x 36, as a\[0\]"):
        encoder.distance(pictures((36, 36)), pictures((36, 40)))
    with pytest.raises(ValueError, match=r"b\[0\]: got values in"):
        encoder.distance(pictures((36, 36)), [2 * pictures((36, 36))[0] - 1])
