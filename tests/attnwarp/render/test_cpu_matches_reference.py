"""The fast backends against the float64 definition: values and gradients, every output and every
parameter.
"""

from __future__ import annotations

import dataclasses
import gc
import math
import weakref

import numpy as np
import pytest
import torch
from backends import GPU
from further import further
from rounding import MODES, excess, leaves_of, maps_and_gradients, mixed_scales, prepared

from attnwarp import Camera, Gaussians
from attnwarp.render import binned, constants, cpu, render
from attnwarp.render.interface import OUTPUTS


@pytest.mark.parametrize("backend", ["cpu", GPU])
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("block", further(*range(8)))
def test_two_hundred_random_scenes_agree_to_1e_5(
    backend: str, block: int, make_camera, make_splats
) -> None:
    """Crossing the camera plane, edge-on, opacity 0 and 1, equal depths are in every scene of 12
    splats or more.
    """
    worst = dict.fromkeys(OUTPUTS, 0.0)
    for seed in range(25 * block, 25 * block + 25):
        rng = np.random.default_rng(seed)
        kind, mode, antialiased = MODES[seed % 4]
        camera = make_camera(seed, int(rng.integers(1, 20)), int(rng.integers(1, 20)))
        count = int(rng.integers(1, 40)) if seed % 5 == 0 else int(rng.integers(12, 40))
        splats = make_splats(seed, kind, count, camera, degree=seed % 4)
        options: dict[str, object] = {"depth": mode, "antialiased": antialiased}
        if seed % 3 == 0:
            options["features"] = torch.tensor(rng.normal(size=(count, seed % 7 + 1)))
            options["background"] = torch.tensor(rng.normal(size=seed % 7 + 1))
        for name, beyond in excess(prepared(splats, camera, **options), backend=backend).items():
            worst[name] = max(worst[name], beyond)
    assert max(worst.values()) < 1e-5, worst


@pytest.mark.parametrize("backend", ["cpu", GPU])
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(("kind", "mode", "antialiased"), MODES)
@pytest.mark.parametrize(("width", "height"), [(300, 35), (32, 32), (49, 130)])
def test_pictures_of_many_tiles_agree(
    backend, kind, mode, antialiased, width, height, make_camera, make_splats
) -> None:
    """Whole tiles and cut ones, and splats that cover more tiles than a row of bits holds."""
    camera = make_camera(11, width, height)
    splats = make_splats(11, kind, 40, camera)
    splats.scales[::4] *= 20
    options = {"depth": mode, "antialiased": antialiased}
    inputs = prepared(splats, camera, **options)
    worst = excess(inputs, backend=backend)
    assert max(worst.values()) < 1e-5, worst
    if width == 300:
        # A row of bits holds 14 tiles: some splat must be wider.
        alone = [
            render(splats.select(torch.tensor([k])), camera, backend=backend, **options)
            for k in range(0, 40, 4)
        ]
        assert max(int((view.alpha > 0).any(0).sum()) for view in alone) > 15 * constants.TILE


@pytest.mark.parametrize("backend", ["cpu", GPU])
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(
    ("kind", "mode", "antialiased", "seeds"),
    [
        *((*mode, range(2)) for mode in MODES),
        *(pytest.param(*mode, range(40), marks=pytest.mark.slow) for mode in MODES),
    ],
)
def test_scales_of_ratio_1e6_agree_to_1e_4(
    backend, kind, mode, antialiased, seeds, make_camera, make_splats
) -> None:
    """Needles and sheets of 1e-3 to 1e3 units in one picture.

    A 2D splat that is narrower than a pixel is as sharp as it is narrow where a ray meets it: its
    alpha may be that of a splat moved by the rounding of a pixel's position. The definition of
    such splats is part of what may come out. A 3D splat is blurred, and has no such excuse.
    """
    worst = dict.fromkeys(OUTPUTS, 0.0)
    for seed in seeds:
        camera = make_camera(seed, 40, 30)
        splats = mixed_scales(make_splats(seed, kind, 24, camera, degree=1), seed + 77, 1e6)
        options = {"depth": mode, "antialiased": antialiased}
        displacements = 8 if kind == "2d" else 0
        for name, beyond in excess(
            prepared(splats, camera, **options), displacements, backend
        ).items():
            worst[name] = max(worst[name], beyond)
    assert max(worst.values()) < 1e-4, worst


@pytest.mark.parametrize("backend", ["cpu", GPU])
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(("kind", "mode", "antialiased"), MODES)
def test_gradients_with_scales_of_ratio_1e6_agree_with_autograd(
    backend, kind, mode, antialiased, make_camera, make_splats
) -> None:
    camera = make_camera(1, 40, 30)
    start = mixed_scales(make_splats(1, kind, 24, camera, degree=1), 78, 1e6).to(
        dtype=torch.float64
    )
    options = {"depth": mode, "antialiased": antialiased}
    gradients = {}

    def weights_of(value):
        return torch.linspace(-1, 1, value.numel(), dtype=torch.float64).sin().reshape(value.shape)

    for each in ("reference", backend):
        leaves = leaves_of(start)
        view = render(Gaussians(kind, *leaves), camera, backend=each, **options)
        for name in OUTPUTS:
            value = getattr(view, name).nan_to_num(0).double()
            gradients[each, name] = torch.autograd.grad(
                (value * weights_of(value)).sum(),
                leaves,
                retain_graph=True,
                materialize_grads=True,
            )
    # The distortion's gradient in an opacity is a sum over 1200 pixels whose weights have either
    # sign: the terms' sizes, by central differences in float64, are hundreds of times their sum.
    # A sum of n terms in float32 keeps sqrt(n) 2^-24 of the terms' sizes (Higham and Mary 2019):
    # n = 2 x 24, the running sums of alpha and of depth over 24 splats, and 22, those over the 16
    # rows of lanes and the 6 tiles.
    rounded = (
        math.sqrt(70) * 2.0**-24 * largest_terms_in_opacity(start, camera, options, weights_of)
    )
    for name in OUTPUTS:
        for leaf, (expected, actual) in enumerate(
            zip(gradients["reference", name], gradients[backend, name], strict=True)
        ):
            scale = float(expected.abs().max())
            bound = 1e-4 * scale + 1e-9
            if name == "distortion_ordered" and leaf == 3:
                bound = max(bound, rounded)
            assert float((actual - expected).abs().max()) <= bound, (name, leaf, scale)


def largest_terms_in_opacity(splats, camera, options, weights_of) -> float:
    """The largest sum of sizes over pixels of a loss's terms of distortion_ordered, as gradients in one
    opacity."""

    def distortion(opacities):
        return render(
            dataclasses.replace(splats, opacities=opacities), camera, backend="reference", **options
        ).distortion_ordered

    step, largest = 1e-6, 0.0
    for k in range(len(splats.opacities)):
        low, high = splats.opacities.clone(), splats.opacities.clone()
        low[k], high[k] = max(0.0, float(low[k]) - step), min(1.0, float(high[k]) + step)
        change = (distortion(high) - distortion(low)) / float(high[k] - low[k])
        largest = max(largest, float((change * weights_of(change)).abs().sum()))
    return largest


@pytest.mark.parametrize("backend", ["cpu", GPU])
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(
    ("kind", "mode", "antialiased", "harmonic", "size"),
    [
        (*mode, harmonic, size)
        for mode in (*MODES, ("3d", "peak", False), ("3d", "center", True))
        for harmonic, size in ((True, (29, 21)), (False, (29, 21)), (True, (70, 45)))
        # The colour's path is independent of depth by centre and of antialiasing.
        if harmonic or (mode[1] != "center" and not mode[2])
    ],
)
def test_gradients_of_every_output_agree_with_autograd(
    backend, kind, mode, antialiased, harmonic, size, make_camera, make_splats
) -> None:
    camera = make_camera(5, *size)
    start = make_splats(5, kind, 30, camera)
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(30, 5, generator=generator, dtype=torch.float64)
    gradients: dict[str, dict[str, list[torch.Tensor]]] = {}
    weights: dict[str, torch.Tensor] = {}
    for each in ("reference", backend):
        leaves = leaves_of(start)
        pose = torch.tensor(camera.world_to_camera).requires_grad_()
        extra = features.clone().requires_grad_()
        behind = torch.linspace(
            0.1, 0.9, 3 if harmonic else 5, dtype=torch.float64
        ).requires_grad_()
        view = render(
            Gaussians(kind, *leaves, origin=np.array([0.2, -0.1, 0.05])),
            camera,
            backend=each,
            depth=mode,
            antialiased=antialiased,
            pose=pose,
            background=behind,
            features=None if harmonic else extra,
        )
        inputs = [*leaves, pose, behind, extra]
        gradients[each] = {}
        for name in OUTPUTS:
            value = getattr(view, name)
            value = torch.where(value.isnan(), 0.0, value).double()
            if name not in weights:
                weights[name] = torch.randn(value.shape, generator=generator, dtype=torch.float64)
            grads = torch.autograd.grad(
                (value * weights[name]).sum(), inputs, retain_graph=True, allow_unused=True
            )
            gradients[each][name] = [
                torch.zeros_like(leaf) if grad is None else grad
                for leaf, grad in zip(inputs, grads, strict=True)
            ]
    names = ("means", "quats", "scales", "opacities", "sh", "pose", "background", "features")
    for name in OUTPUTS:
        for leaf, expected, actual in zip(
            names, gradients["reference"][name], gradients[backend][name], strict=True
        ):
            assert torch.isfinite(actual).all(), (name, leaf)
            # Sums over 600 pixels in float32, of the largest entry: the smallest carry its
            # rounding. Edge-on splats have slopes of 1/cos that cancel between pixels.
            scale = float(expected.abs().max())
            assert float((actual - expected).abs().max()) <= 1e-4 * scale + 1e-9, (
                name,
                leaf,
                scale,
            )


def test_gradients_reach_float32_parameters_in_their_own_type(make_camera, make_splats) -> None:
    camera = make_camera(1, 16, 16)
    splats = make_splats(1, "2d", 20, camera).to(dtype=torch.float32)
    splats.means.requires_grad_()
    splats.opacities.requires_grad_()
    view = render(splats, camera)
    view.color.sum().backward()
    assert view.color.dtype == torch.float32
    assert splats.means.grad is not None and splats.means.grad.dtype == torch.float32
    assert splats.opacities.grad is not None and splats.sh.grad is None


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_the_bits_do_not_depend_on_the_number_of_threads(kind, make_camera, make_splats) -> None:
    camera = make_camera(2, 67, 45)
    start = make_splats(2, kind, 5000, camera)
    seen = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            seen.append(maps_and_gradients(start, camera, "cpu"))
    finally:
        torch.set_num_threads(threads)
    for other in seen[1:]:
        assert all(map(torch.equal, seen[0], other))


def test_gradients_gathered_in_small_groups_of_tiles_are_the_same(
    make_camera, make_splats, monkeypatch
) -> None:
    camera = make_camera(3, 50, 40)
    start = make_splats(3, "2d", 300, camera)

    def gradient() -> torch.Tensor:
        means = start.means.clone().requires_grad_()
        view = render(dataclasses.replace(start, means=means), camera)
        (
            view.color.sum() + view.depth.nan_to_num().sum() + view.distortion_ordered.sum()
        ).backward()
        assert means.grad is not None
        return means.grad

    whole = gradient()
    monkeypatch.setattr(cpu, "GRADIENT_ROWS", 64)
    assert torch.equal(whole, gradient())


def test_more_runs_of_tiles_than_there_was_room_for_change_nothing(
    make_camera, make_splats, monkeypatch
) -> None:
    camera = make_camera(3, 200, 160)
    splats = make_splats(3, "2d", 600, camera)
    expected = render(splats, camera)
    monkeypatch.setattr(binned, "RUNS_PER_SPLAT", 0.0)
    again = render(splats, camera)
    assert expected.counters == again.counters and expected.counters["visible"] > 300
    for name in OUTPUTS:
        assert torch.equal(
            getattr(expected, name).nan_to_num(-1), getattr(again, name).nan_to_num(-1)
        ), name


@pytest.mark.parametrize("mode", ["intersection", "center"])
def test_depth_of_a_splat_that_faces_the_camera_moves_with_it(mode, facing, front_camera) -> None:
    """Closed form: everywhere z is the centre's, so every pixel's depth has the slope 1. The bounds
    of z fall together here.
    """
    splats = facing([[0, 0, 3]], 0.3, 0.9)
    splats.means.requires_grad_()
    view = render(splats, front_camera(), backend="cpu", depth=mode)
    view.depth[view.valid].sum().backward()
    pixels = int(view.valid.sum())
    assert pixels > 50 and splats.means.grad is not None
    assert splats.means.grad[0].tolist() == pytest.approx(
        [0, 0, pixels], rel=1e-6, abs=1e-4 * pixels
    )


def test_a_picture_wider_than_the_lists_can_say_is_refused(facing) -> None:
    camera = Camera.look_at([0, 0, 0], [0, 0, 1], width=131_100, height=1, fov_y=1, up=[0, -1, 0])
    with pytest.raises(ValueError, match="131100 pixels wide"):
        render(facing([[0, 0, 3]]), camera, backend="cpu")


def test_it_may_be_called_from_many_threads_at_once(make_camera, make_splats) -> None:
    from concurrent.futures import ThreadPoolExecutor

    camera = make_camera(4, 40, 40)
    splats = make_splats(4, "3d", 500, camera)
    expected = render(splats, camera).color
    with ThreadPoolExecutor(4) as pool:
        for result in pool.map(lambda _: render(splats, camera).color, range(12)):
            assert torch.equal(result, expected)


def test_it_works_in_a_forked_child(make_camera, make_splats) -> None:
    import os

    camera = make_camera(4, 40, 40)
    splats = make_splats(4, "2d", 9000, camera)
    expected = render(splats, camera).color
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        same = torch.equal(render(splats, camera).color, expected)
        os.write(writing, b"1" if same else b"0")
        os._exit(0)
    os.waitpid(child, 0)
    assert os.read(reading, 1) == b"1"


@pytest.mark.door
def test_changing_a_parameter_in_place_before_the_backward_pass_is_an_error(
    make_camera, make_splats
) -> None:
    camera = make_camera(4, 16, 16)
    splats = make_splats(4, "2d", 20, camera)
    means = splats.means.clone().requires_grad_()
    loss = render(dataclasses.replace(splats, means=means), camera).color.sum()
    with torch.no_grad():
        means += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


READ_BY_OWN_GRADIENTS = {
    "alpha": {"depth", "distortion_ordered"},
    "depth": {"depth", "distortion_ordered"},
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_changing_an_output_in_place_gives_its_gradients_or_an_error(
    name: str, make_camera, make_splats
) -> None:
    """The backward pass reads some outputs. Oracle: the reference, and the output left as it was."""
    camera = make_camera(4, 16, 16)
    splats = make_splats(4, "2d", 20, camera)

    def gradient(backend: str, change) -> torch.Tensor:
        means = splats.means.clone().requires_grad_()
        view = render(dataclasses.replace(splats, means=means), camera, backend=backend)
        others = sum(getattr(view, each).nansum() for each in OUTPUTS if each != name)
        (others + change(getattr(view, name)).nansum()).backward()
        return means.grad

    expected = gradient("reference", lambda output: output / 3)
    try:
        got = gradient("cpu", lambda output: output.div_(3))
    except RuntimeError as error:
        assert "modified by an inplace operation" in str(error)
        assert name in READ_BY_OWN_GRADIENTS
    else:
        assert (got - expected).abs().max() < 1e-3 * expected.abs().max()


@pytest.mark.parametrize("width", [16, 13])  # a whole tile and a part of one
@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
@pytest.mark.parametrize("changed", READ_BY_OWN_GRADIENTS)
def test_a_changed_map_hinders_only_the_gradients_that_read_it(
    changed: str, value: float, width: int, make_camera, make_splats
) -> None:
    """Oracle: the gradients of a render whose maps are left as they were, bit for bit."""
    camera = make_camera(4, width, 16)
    splats = make_splats(4, "2d", 20, camera)

    def gradient(name: str, change: bool) -> torch.Tensor:
        means = splats.means.clone().requires_grad_()
        # Of a background only the gradient of a colour reads alpha.
        background = torch.tensor([0.2, 0.5, 0.9], requires_grad=name != "color")
        view = render(dataclasses.replace(splats, means=means), camera, background=background)
        output = getattr(view, name)
        upstream = torch.linspace(-1, 1, output.numel()).reshape(output.shape)
        if change:
            with torch.no_grad():
                getattr(view, changed).fill_(value)
        return torch.autograd.grad(output, means, upstream)[0]

    for name in OUTPUTS:
        if name in READ_BY_OWN_GRADIENTS[changed]:
            with pytest.raises(RuntimeError, match=rf"{changed}: .*inplace.*gradient of {name}"):
                gradient(name, True)
        else:
            assert torch.equal(gradient(name, True), gradient(name, False))


@pytest.mark.door
def test_a_changed_alpha_is_refused_by_a_backgrounds_gradient(make_camera, make_splats) -> None:
    camera = make_camera(4, 16, 16)
    background = torch.zeros(3, requires_grad=True)
    view = render(make_splats(4, "2d", 20, camera), camera, background=background)
    loss = view.color.sum()
    view.alpha.clamp_(0, 0.5)
    with pytest.raises(RuntimeError, match=r"gradient of background reads it; .*alpha\.clone"):
        loss.backward()


def test_a_picture_that_no_backward_pass_followed_leaves_no_memory_behind(
    make_camera, make_splats
) -> None:
    """A cycle of references would hold each picture until the garbage is collected."""
    camera = make_camera(4, 16, 16)
    splats = make_splats(4, "2d", 20, camera)
    means = splats.means.clone().requires_grad_()
    gc.collect()
    gc.disable()
    try:
        view = render(dataclasses.replace(splats, means=means), camera)
        left = [weakref.ref(view.depth), weakref.ref(view.depth.grad_fn), weakref.ref(view.alpha)]
        del view
        assert [reference() for reference in left] == [None] * 3
    finally:
        gc.enable()


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_a_deep_scene_worked_off_from_the_front_is_the_same(
    kind, make_camera, make_splats, monkeypatch
) -> None:
    """Begun with the nearest splats only; tiles that are not opaque by then start again; and lists
    too long to be held at once made for some tiles after the others. Same bits either way."""
    camera = make_camera(3, 50, 40)
    start = make_splats(3, kind, 2000, camera)
    results = []
    all_at_once = (binned.FRONT, binned.ENTRIES)
    for front, entries in (all_at_once, (60, 8), (3, 1), (binned.FRONT, 0.5), (60, 1e-3)):
        monkeypatch.setattr(binned, "FRONT", front)
        monkeypatch.setattr(binned, "ENTRIES", entries)
        means = start.means.clone().requires_grad_()
        view = render(dataclasses.replace(start, means=means), camera)
        (
            view.color.sum() + view.depth.nan_to_num().sum() + view.distortion_ordered.sum()
        ).backward()
        assert means.grad is not None
        results.append(
            [getattr(view, name).detach().nan_to_num(-1) for name in OUTPUTS] + [means.grad]
        )
        results[-1].append(torch.tensor(view.counters["contributing"]))
    for other in results[1:]:
        assert all(map(torch.equal, results[0], other))
