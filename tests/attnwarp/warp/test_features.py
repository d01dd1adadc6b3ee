"""Tokens against feature maps sampled by torch."""

import dataclasses

import numpy as np
import pytest
import torch
from closed_forms import orbit, sphere

from attnwarp import Camera
from attnwarp.render.threads import set_thread_count
from attnwarp.warp import FeatureWarp, correspond, cpu, sampling
from attnwarp.warp.settings import preset
from attnwarp.warp.view import Surface, warp_surfaces


@pytest.fixture(scope="module")
def layer():
    """A sphere seen from two sides at 64 x 48, warped on grids of 16 x 12."""
    source, target = (orbit(yaw, size=48, width=64, height=h) for yaw, h in ((0, 0.3), (30, 0.0)))
    surfaces = [Surface(*sphere(camera)) for camera in (target, source)]
    return warp_surfaces(source, target, *surfaces, preset("corrected", opaque=None)).at((12, 16))


def tokens_of(maps):
    return maps.flatten(2).transpose(1, 2).contiguous()


def random_maps(layer, *, batch=2, channels=5, dtype=torch.float32, seed=0):
    size = (layer.correspondence.source.height, layer.correspondence.source.width)
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, channels, *size, generator=generator).to(dtype)


def grid_sampled(layer, maps):
    """torch's own sampling in float64; 0 where a pixel has no position."""
    c = layer.correspondence
    grid = 2 * c.xy / torch.tensor([c.source.width, c.source.height]) - 1
    grid = torch.where(c.defined[..., None], grid, 0)[None].expand(len(maps), -1, -1, -1)
    warped = torch.nn.functional.grid_sample(
        maps.double(), grid, padding_mode="border", align_corners=False
    )
    return torch.where(c.defined, warped, 0)


def test_tokens_warp_as_torch_samples_their_maps(layer):
    maps = random_maps(layer)
    warped = layer.warp_tokens(tokens_of(maps))
    assert (warped - tokens_of(grid_sampled(layer, maps))).abs().max() < 1e-5
    assert 0.1 < layer.mask.float().mean() < 0.9


# The kernels against the definition: products and sums come in one order, so bits are equal

FLOATS = [torch.float32, torch.float16, torch.bfloat16, torch.float64]


def bits(tensor):
    """Integers of the tensor's own bytes: NaN and signed zeros are compared as they are."""
    whole = {2: torch.int16, 4: torch.int32, 8: torch.int64}[tensor.element_size()]
    return tensor.contiguous().view(whole)


def both(layer, call):
    """Results of the kernels and of the definition, each with taps of its own."""
    kernels, definition = (
        dataclasses.replace(layer, backend=backend) for backend in ("auto", "reference")
    )
    return call(kernels), call(definition)


@pytest.mark.parametrize("dtype", FLOATS, ids=str)
@pytest.mark.parametrize("channels", [1, 5, 40])
def test_kernels_have_the_bits_of_the_definition(layer, dtype, channels):
    maps = random_maps(layer, dtype=dtype, channels=channels)
    maps[0, 0, 3:5, 4:7] = torch.tensor([torch.nan, torch.inf, -torch.inf])
    maps[1, -1, 6] = 0.0
    rows = tokens_of(maps)
    for call in (
        lambda warp: warp.warp(maps),
        lambda warp: warp.warp(maps[0]),
        lambda warp: warp.warp_tokens(rows),
    ):
        kernels, definition = both(layer, call)
        assert kernels.dtype == dtype
        assert torch.equal(torch.isnan(kernels), torch.isnan(definition))
        number = ~torch.isnan(definition)
        assert torch.equal(bits(kernels)[number], bits(definition)[number])


@pytest.mark.parametrize("centers", ["half", "integer"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("size", [(16, 12), (8, 6), (1, 1), (31, 23)])
def test_taps_by_kernels_have_the_bits_of_the_definition(centers, dtype, size):
    # Positions beyond all borders, within rounding of pixel centres, and undefined ones.
    camera = Camera(np.array([[16.0, 0, 6], [0, 16.0, 8], [0, 0, 1]]), np.eye(4), 12, 16)
    c = correspond(camera, camera, np.full((16, 12), 2.0), pixel_centers=centers)
    random = torch.Generator().manual_seed(0)
    xy = 40 * torch.rand(16, 12, 2, generator=random, dtype=torch.float64) - 12
    xy[0] = xy[0].round() + 0.5 + 1e-8 * torch.randn(12, 2, generator=random)
    xy[1, :4, 0] = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e300])
    moved = dataclasses.replace(c, xy=xy)
    got, expected = (engine.taps_at(moved, size, dtype, xy.device) for engine in (cpu, sampling))
    assert torch.equal(got.index.long(), expected.index.long())
    assert got.weight.dtype == expected.weight.dtype == dtype
    assert torch.equal(bits(got.weight), bits(expected.weight))
    for ours, definition in zip(got.arrays, expected.arrays, strict=True):
        assert ours.dtype == definition.dtype and np.array_equal(ours, definition)


def test_maps_of_any_size_and_tokens_that_are_not_contiguous_are_read_right(layer):
    maps = random_maps(layer, channels=6)
    larger = torch.nn.functional.interpolate(maps, scale_factor=3)
    kernels, definition = both(layer, lambda warp: warp.warp(larger))
    assert torch.equal(kernels, definition)
    strided = maps.flatten(2).transpose(1, 2)
    assert not strided.is_contiguous()
    assert torch.equal(layer.warp_tokens(strided), layer.warp_tokens(strided.contiguous()))


def test_taps_of_no_weight_are_never_read_and_undefined_pixels_give_0(layer):
    # Hard case 36. The identity has one tap of weight 1 a pixel; the others hold NaN.
    camera = layer.correspondence.target
    surface = Surface(*sphere(camera))
    same = warp_surfaces(camera, camera, surface, surface, preset("corrected", opaque=None))
    identity = same.at((camera.height, camera.width))
    seen = identity.correspondence.defined.reshape(-1)
    tokens = torch.full((1, camera.height * camera.width, 3), torch.nan)
    tokens[:, seen] = torch.arange(3.0) - 1
    warped = identity.warp_tokens(tokens)
    assert 0 < seen.sum() < len(seen)
    assert torch.equal(warped[:, seen], tokens[:, seen])
    assert (warped[:, ~seen] == 0).all()


@pytest.mark.parametrize("dtype", FLOATS, ids=str)
def test_bits_do_not_depend_on_threads(layer, dtype):
    def results():
        source = tokens_of(random_maps(layer, dtype=dtype, channels=1300)).requires_grad_()
        maps = random_maps(layer, dtype=dtype, channels=70).requires_grad_()
        outputs = [layer.warp_tokens(source), layer.warp(maps)]
        torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])
        return [bits(t.detach()) for t in (*outputs, source.grad, maps.grad)]

    try:
        set_thread_count(1)
        alone = results()
        set_thread_count(4)
        assert all(torch.equal(a, b) for a, b in zip(alone, results(), strict=True))
    finally:
        set_thread_count(None)


def test_gradients_are_those_of_torchs_own_sampling(layer):
    maps = random_maps(layer, dtype=torch.float64).requires_grad_()
    weigh = random_maps(layer, dtype=torch.float64, seed=2)
    (expected,) = torch.autograd.grad((grid_sampled(layer, maps) * weigh).sum(), maps)
    for loss in (
        (layer.warp(maps) * weigh).sum(),
        (layer.warp_tokens(tokens_of(maps)) * tokens_of(weigh)).sum(),
    ):
        (gradient,) = torch.autograd.grad(loss, maps)
        # SNAP moves a position by up to 1e-7 px.
        assert (gradient - expected).abs().max() < 1e-5


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda w, s: w.warp_tokens(s[0]),
            r"source: got shape \(192, 5\), expected \(B, 192, C\)",
        ),
        (lambda w, s: w.warp_tokens(s[:, 1:]), r"source: got shape \(2, 191, 5\)"),
        (lambda w, s: w.warp_tokens(s.long()), r"source: got torch\.int64, expected a floating"),
        (
            lambda w, s: w.warp(torch.ones(5, 12, 16, dtype=torch.int64)),
            r"features: got torch\.int64, expected a floating",
        ),
        (lambda w, s: w.warp(s[0]), r"features: got shape \(192, 5\)"),
        (lambda w, s: w.warp(torch.rand(3, 0, 80)), "features: got 0 x 80 .* at least 1 x 1"),
    ],
)
def test_the_doors_for_tokens_say_what_came_and_what_was_expected(layer, call, message):
    source = tokens_of(random_maps(layer))
    with pytest.raises(ValueError, match=message):
        call(layer, source)


def test_lists_in_place_of_tensors_are_named(layer):
    rows = tokens_of(random_maps(layer))
    for call, name in (
        (lambda: layer.warp(rows.tolist()), "features"),
        (lambda: layer.warp_tokens(rows.tolist()), "source"),
    ):
        with pytest.raises(TypeError, match=f"{name}: got list, expected (a )?torch.Tensor"):
            call()


def test_a_map_is_taken_at_every_size_that_a_network_makes_of_the_picture_and_not_transposed():
    """Oracle: the sizes that torch's own pooling and resizing give."""
    K = np.array([[60.0, 0, 40], [0, 60.0, 40], [0, 0, 1]])
    depth = np.full((8, 8), 2.0)
    for height, width in ((96, 160), (99, 165), (45, 1000), (37, 61)):
        source = Camera(K, np.eye(4), width, height)
        c = correspond(source, Camera(K, np.eye(4), 8, 8), depth)
        layer = FeatureWarp(c, c.defined)
        picture = torch.rand(1, 1, height, width)
        pool = torch.nn.functional.avg_pool2d
        maps = [pool(picture, by, ceil_mode=up) for by in (2, 3, 8, 14) for up in (False, True)]
        twice = pool(pool(picture, 2, ceil_mode=True), 4)
        maps += [twice, pool(pool(picture, 2), 4, ceil_mode=True)]
        maps += [torch.nn.functional.interpolate(picture, scale_factor=s) for s in (0.3, 0.17, 1.7)]
        for features in maps:
            assert layer.warp(features).shape == (1, 1, 8, 8)
            with pytest.raises(ValueError, match=r"features: got .* expected the aspect ratio of"):
                layer.warp(features.mT)
    # A picture squeezed into a square, as for a vision transformer: the layer says so.
    squeezed = FeatureWarp(correspond(source.resize(16, 16), c.target, depth), c.defined)
    assert squeezed.warp(torch.rand(4, 16, 16)).shape == (4, 8, 8)


def test_a_layer_makes_its_taps_once(layer, monkeypatch):
    made = []
    original = cpu.taps_at
    monkeypatch.setattr(cpu, "taps_at", lambda *a: made.append(a) or original(*a))
    fresh = dataclasses.replace(layer)
    for dtype in (torch.float32, torch.float16, torch.float32):
        rows = tokens_of(random_maps(layer, dtype=dtype))
        fresh.warp_tokens(rows)
        fresh.warp(random_maps(layer, dtype=dtype))
    assert len(made) == 1
