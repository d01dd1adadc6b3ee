"""Oracles: diffusers' own pipelines and processors, written-out blends in float64, the memory of the tensors."""

import numpy as np
import pytest
import torch
from diffusers import (
    HeunDiscreteScheduler,
    KDPM2DiscreteScheduler,
    PNDMScheduler,
    UNet2DConditionModel,
)
from diffusers.models.attention_processor import AttnProcessor2_0
from further import further
from tiny_editors import controlnet, pix2pix, unet

from attnwarp.camera import Camera
from attnwarp.editing.layers import (
    CONTROLNET_BRANCHES,
    PIX2PIX_BRANCHES,
    BareUNet,
    all_layers,
    choose_layers,
    hooked,
    paper_layers,
)
from attnwarp.editing.recording import RecordingPlan, record
from attnwarp.methods.algorithms.attention_warping import a_t, inject
from attnwarp.warp import Surface, WarpSettings, warp_surfaces

SIZE = (6, 8)
"""Latents that are not square."""


def plan_of(net, *, layers=None, size=SIZE, keep=("text", "image"), steps=2, **more):
    return RecordingPlan(layers or paper_layers(net), size, keep, steps, **more)


def of(net, branches=PIX2PIX_BRANCHES):
    return BareUNet(net, branches)


def run(net, *, seed=0, timesteps=(981, 481), rows=3, size=SIZE):
    """Passes of a UNet, as a pipeline makes them; their outputs."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn((rows, net.config.in_channels, *size), generator=generator)
    text = torch.randn((rows, 5, 32), generator=generator)
    with torch.no_grad():
        return torch.stack(
            [net(x, torch.tensor(t), encoder_hidden_states=text).sample for t in timesteps]
        )


class Kept(AttnProcessor2_0):
    """diffusers' own processor, which keeps what it returns."""

    def __init__(self):
        super().__init__()
        self.outputs = []

    def __call__(self, *args, **kwargs):
        self.outputs.append(super().__call__(*args, **kwargs))
        return self.outputs[-1]


def test_layers_of_stable_diffusion_are_the_papers_twelve_and_take_the_memory_that_it_takes():
    with torch.device("meta"):
        net = UNet2DConditionModel(
            cross_attention_dim=768, attention_head_dim=8
        )  # the defaults are SD 1.5's
    layers = paper_layers(net)
    assert len(layers) == 12
    assert {layer.name.split(".")[1] for layer in layers} == {"2", "3"}
    assert {layer.size((64, 64)) for layer in layers} == {(64, 64), (32, 32)}
    # 6 layers of 320 channels at 64 x 64 and 6 of 640 at 32 x 32; two branches in half precision for 20 steps.
    plan = RecordingPlan(layers, (64, 64), ("text", "image"), 20, dtype=torch.float16)
    assert plan.bytes == 6 * (64 * 64 * 320 + 32 * 32 * 640) * 2 * 2 * 20
    assert "12 layers, 2 branches (text, image), 20 steps in float16: 900.0 MiB" in str(plan)


def test_layers_are_chosen_by_kind_and_by_their_blocks_number():
    net = unet()
    assert {layer.kind for layer in choose_layers(paper_layers(net), kinds=("cross",))} == {"cross"}
    assert {layer.level for layer in choose_layers(paper_layers(net), blocks=(0,))} == {1}
    assert {layer.name.split(".")[0] for layer in paper_layers(net)} == {"up_blocks"}
    assert len(all_layers(net)) == len(net.attn_processors) > len(paper_layers(net))
    with pytest.raises(ValueError, match=r"kinds, blocks: got None in \(2,\); .* cross in block 0"):
        choose_layers(paper_layers(net), blocks=(2,))
    with pytest.raises(ValueError, match="did you mean 'cross'"):
        choose_layers(paper_layers(net), kinds=("crss",))


@pytest.mark.parametrize("size", [(6, 8), (5, 7), (8, 8)])
def test_a_recording_holds_what_the_processors_return(size):
    net = unet(8)
    plan = plan_of(net, size=size)
    with record(of(net), plan) as recording:
        run(net, size=size)
    processors = {name: Kept() for name in net.attn_processors}
    net.set_attn_processor(dict(processors))
    run(net, size=size)
    for layer in plan.layers:
        outputs = processors[f"{layer.name}.processor"].outputs
        h, w = layer.size(size)
        assert outputs[0].shape == (3, h * w, layer.channels)
        for step, timestep in enumerate((981.0, 481.0)):
            for branch, row in (("text", 0), ("image", 1)):
                assert torch.equal(
                    recording.features(timestep, layer, branch), outputs[step][row : row + 1]
                )
    assert recording.timesteps == [981.0, 481.0]
    assert repr(recording) == f"Recording(2 steps so far of: {plan})" and len(repr(recording)) < 150


@pytest.mark.parametrize("rows", [1, 3])
def test_recording_changes_no_bit_and_leaves_no_hook(rows):
    net = unet(8)
    branches = PIX2PIX_BRANCHES[:rows]
    before = run(net, rows=rows)
    with record(of(net, branches), plan_of(net, keep=("text",))) as recording:
        during = run(net, rows=rows)
    assert torch.equal(before, during)
    assert recording.bytes > 0
    bytes_then = recording.bytes
    assert torch.equal(before, run(net, rows=rows))
    assert recording.bytes == bytes_then


@pytest.mark.parametrize("pipeline", ["pix2pix", "controlnet"])
def test_recording_changes_no_bit_of_diffusers_own_pipelines(pipeline):
    pipe = pix2pix() if pipeline == "pix2pix" else controlnet()
    branches, keep = (
        (PIX2PIX_BRANCHES, ("text", "image"))
        if pipeline == "pix2pix"
        else (CONTROLNET_BRANCHES, CONTROLNET_BRANCHES)
    )
    picture = torch.rand((1, 3, 16, 24), generator=torch.Generator().manual_seed(4))
    more = {} if pipeline == "pix2pix" else {"height": 16, "width": 24}

    def images():
        return pipe(
            "bear", image=picture, num_inference_steps=3, output_type="np", generator=torch.Generator().manual_seed(5), **more
        ).images  # fmt: skip

    before = images()
    plan = plan_of(pipe.unet, size=(8, 12), keep=keep, steps=3)
    passes = of(pipe.unet, branches)
    with record(passes, plan) as recording:
        assert np.array_equal(before, images())
    assert len(recording.timesteps) == 3
    with inject(passes, recording, weight=lambda t, T: 1.0):
        assert np.array_equal(before, images())


@pytest.mark.parametrize(
    ("scheduler", "options", "steps"),
    further(
        (HeunDiscreteScheduler, {}, 3),
        (PNDMScheduler, {"skip_prk_steps": True}, 4),
        (KDPM2DiscreteScheduler, {}, 3),
    ),
)
def test_of_a_scheduler_with_more_passes_than_steps_each_pass_has_its_own_features(
    scheduler, options, steps
):
    """Oracle: diffusers' own pipeline, whose pictures their own features leave as they are."""
    pipe = controlnet()
    pipe.scheduler = scheduler.from_config(pipe.scheduler.config, **options)
    picture = torch.rand((1, 3, 16, 24), generator=torch.Generator().manual_seed(4))

    def images():
        return pipe(
            "bear", image=picture, num_inference_steps=steps, output_type="np", height=16, width=24,
            generator=torch.Generator().manual_seed(5),
        ).images  # fmt: skip

    before, passes = images(), len(pipe.scheduler.timesteps)
    assert passes > steps
    plan = plan_of(
        pipe.unet,
        size=(8, 12),
        keep=CONTROLNET_BRANCHES,
        steps=passes,
    )
    bare = of(pipe.unet, CONTROLNET_BRANCHES)
    with record(bare, plan) as recording:
        assert np.array_equal(before, images())
    given = recording.timesteps
    assert given == [float(t) for t in pipe.scheduler.timesteps]
    weights = []

    def weight(step, count):
        weights.append((step, count))
        return 1.0

    with inject(bare, recording, weight=weight):
        assert np.array_equal(before, images())
        assert np.array_equal(before, images())  # a second run begins anew
    numbers = [step for step, _ in weights[:: len(plan.layers)]]
    assert numbers == 2 * list(range(passes)) and {count for _, count in weights} == {passes}


def camera(width=48, height=36, x=0.0):
    K = np.array([[40.0, 0, width / 2], [0, 40.0, height / 2], [0, 0, 1]])
    pose = np.eye(4)
    pose[0, 3] = -x
    return Camera(K, pose, width, height)


def between(source, target, depth=2.0):
    """Two views of a wall; with one camera, the identity."""
    surface = Surface(torch.full((target.height, target.width), depth, dtype=torch.float64))
    return warp_surfaces(
        source,
        target,
        surface,
        surface,
        WarpSettings(opaque=None, normal_test="none", depth_agreement=False),
    )


def test_a_views_own_features_at_full_weight_with_the_identity_change_no_bit():
    net = unet(8)
    plain = run(net)
    with record(of(net), plan_of(net)) as recording:
        run(net)
    identity = between(camera(), camera())
    for warp in (None, identity):
        with inject(of(net), recording, warps=(warp,), weight=lambda t, T: 1.0):
            assert torch.equal(plain, run(net))
        # Another run's features do change it, or the test above would show nothing.
        with inject(of(net), recording, warps=(warp,), weight=lambda t, T: 1.0):
            assert not torch.equal(run(net, seed=1), plain)


def test_a_recorded_branch_that_the_batch_lacks_leaves_the_others_their_features():
    """With equal text and image guidance, the branch of the picture alone does not run. Oracle: a
    recording without that branch.
    """
    net = unet(8)
    outputs = []
    for keep in (("text", "image"), ("text",)):
        with record(of(net), plan_of(net, keep=keep)) as recording:
            run(net)
        with inject(of(net, ("text",)), recording, weight=lambda t, T: 0.5):
            outputs.append(run(net, seed=1, rows=1))
    assert torch.equal(*outputs)
    assert not torch.equal(outputs[0], run(net, seed=1, rows=1))


def test_weight_zero_changes_no_bit():
    net = unet(8)
    with record(of(net), plan_of(net)) as recording:
        run(net)
    other = run(net, seed=1)
    with inject(of(net), recording, weight=lambda t, T: 0.0):
        assert torch.equal(other, run(net, seed=1))


def test_injected_features_are_the_written_out_blend_at_each_layers_own_size():
    net = unet(8)
    first = paper_layers(net)[0]  # its own features hold nothing injected before it
    with record(of(net), plan_of(net, layers=(first,), steps=1)) as recording:
        run(net, timesteps=(500,))
    source, target = camera(), camera(x=0.3)
    view = between(source, target)
    region = torch.zeros((36, 48), dtype=torch.bool)
    region[:, :30] = True
    view = view.with_mask(view.mask & region)
    own, blended = {}, {}

    def keep(into):
        return lambda layer, features, call: into.__setitem__(layer.name, features.clone())

    with hooked(of(net), [first], keep(own)):
        run(net, seed=1, timesteps=(500,))
    with inject(of(net), recording, warps=(view,), weight=lambda t, T: 0.7
    ), hooked(of(net), [first], keep(blended)):  # fmt: skip
        run(net, seed=1, timesteps=(500,))
    h, w = first.size(SIZE)
    new, got = own[first.name].double(), blended[first.name].double()
    shift = (
        40 / 2 * 0.3 * w / 48
    )  # f / z * baseline, in cells: where the target's point lies in the source
    for row, branch in ((0, "text"), (1, "image")):
        recorded = recording.features(500.0, first, branch)[0].double().reshape(h, w, -1)
        for y in range(h):
            for x in range(w):
                u = x + 0.5 + shift
                inside = u < w and (x + 0.5) * 48 / w < 30
                u = min(u, w - 0.5)
                low = int(np.floor(u - 0.5))
                part = u - 0.5 - low
                high = min(low + 1, w - 1)
                warped = (1 - part) * recorded[y, low] + part * recorded[y, high]
                mine = new[row, y * w + x]
                expected = 0.7 * warped + 0.3 * mine if inside else mine
                assert torch.allclose(got[row, y * w + x], expected, rtol=0, atol=1e-5), (
                    branch,
                    y,
                    x,
                )
    assert torch.equal(own[first.name][2], blended[first.name][2])  # the unconditional branch


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_a_blend_without_a_warp_in_half_precision_is_rounded_once(dtype):
    """Oracle: the formula in float64. A second rounding would be another half step."""
    net = unet(8).to(dtype)
    first = paper_layers(net)[0]
    tokens = {}

    def run_half(name, seed):
        generator = torch.Generator().manual_seed(seed)
        x = torch.randn((3, 8, *SIZE), generator=generator).to(dtype)
        text = torch.randn((3, 5, 32), generator=generator).to(dtype)
        keep = hooked(
            of(net), [first], lambda _, features, __: tokens.update({name: features.clone()})
        )
        with torch.no_grad(), keep:
            net(x, torch.tensor(500), encoder_hidden_states=text)

    with record(of(net), plan_of(net, layers=(first,), steps=1)) as recording:
        run_half("source", seed=0)
    run_half("new", seed=1)
    with inject(of(net), recording, weight=lambda t, T: 0.9):
        run_half("blend", seed=1)
    source, new, blend = (tokens[name][:2] for name in ("source", "new", "blend"))
    expected = 0.9 * source.double() + (1 - 0.9) * new.double()
    allowed = torch.finfo(dtype).eps / 2 * expected.abs() + 1e-6
    assert ((blend.double() - expected).abs() <= allowed).all()
    assert blend.dtype == dtype


def test_one_source_serves_several_views_each_with_its_own_warp():
    net = unet(8)
    with record(of(net), plan_of(net)) as recording:
        run(net)
    views = (between(camera(), camera(x=0.3)), None)
    with inject(of(net), recording, warps=views, weight=lambda t, T: 0.5):
        together = run(net, rows=6, seed=2)
    # Rows of a batch do not mix, so each view alone gives the same up to the order of sums.
    x = torch.Generator().manual_seed(2)
    sample = torch.randn((6, 8, *SIZE), generator=x)
    text = torch.randn((6, 5, 32), generator=x)
    for k, view in enumerate(views):
        rows = [k, 2 + k, 4 + k]
        with (
            torch.no_grad(),
            inject(of(net), recording, warps=(view,), weight=lambda t, T: 0.5),
        ):
            alone = torch.stack(
                [net(sample[rows], torch.tensor(t), text[rows]).sample for t in (981, 481)]
            )
        assert torch.allclose(together[:, rows], alone, rtol=0, atol=1e-5)


def test_a_blend_leaves_what_the_processor_returned_and_has_one_result_with_and_without_gradient():
    net = unet(8)
    first, view = paper_layers(net)[0], between(camera(), camera(x=0.3))
    with record(of(net), plan_of(net, layers=(first,), steps=1)) as recording:
        run(net, timesteps=(500,))
    processor = Kept()
    net.get_submodule(first.name).set_processor(processor)
    sample, text = torch.randn(3, 8, *SIZE), torch.randn(3, 5, 32)

    def output(gradient):
        with torch.set_grad_enabled(gradient):
            return net(sample, torch.tensor(500), text).sample.detach()

    with inject(of(net), recording, warps=(view,)):
        blended = [output(gradient) for gradient in (False, True)]
    assert torch.equal(*blended)
    assert not torch.equal(blended[0], output(False))
    *during, alone = processor.outputs
    assert all(torch.equal(features, alone) for features in during)


def test_the_weight_falls_as_the_paper_says():
    weights = [a_t(step, 20) for step in range(20)]
    assert weights == pytest.approx(np.linspace(0.9, 0, 20, endpoint=False))


@pytest.mark.parametrize(
    ("store", "dtype"), [("device", torch.float32), ("cpu", torch.float16), ("disk", torch.float16)]
)
def test_the_memory_is_what_was_planned_and_features_come_back_from_where_they_lie(
    store, dtype, tmp_path
):
    net = unet(8)
    plan = plan_of(
        net, size=(16, 24), dtype=dtype, store=tmp_path / "features" if store == "disk" else store
    )
    with record(of(net), plan) as recording:
        run(net, size=(16, 24))
    assert recording.bytes == pytest.approx(plan.bytes, rel=0.1)  # files have headers
    with record(of(net), plan_of(net, size=(16, 24))) as full:
        run(net, size=(16, 24))
    for layer in plan.layers:
        stored = recording.features(981.0, layer, "image")
        assert stored.dtype == dtype
        assert torch.equal(stored, full.features(981.0, layer, "image").to(dtype))
    if store == "disk":
        files = list((tmp_path / "features").rglob("*.safetensors"))
        assert len(files) == 2 * 2 * len(plan.layers)  # of each step, a file a branch


def test_chosen_steps_alone_are_stored_and_injected():
    """Oracle: the whole recording, injected with a weight of 0 at the other steps."""
    net = unet(8)
    timesteps = (981, 721, 481, 241)
    with record(of(net), plan_of(net, steps=4)) as whole:
        run(net, timesteps=timesteps)
    with record(of(net), plan_of(net, steps=4, chosen=[2, 0])) as some:
        run(net, timesteps=timesteps)
    assert some.timesteps == whole.timesteps
    assert some.bytes == some.plan.bytes == whole.bytes / 2
    assert "2 of 4 steps in float32" in str(some.plan)
    layer = some.plan.layers[0]
    assert torch.equal(some.features(481.0, layer, "text"), whole.features(481.0, layer, "text"))
    with pytest.raises(ValueError, match="timestep: 721 is step 1, .* not chosen; those of 0, 2"):
        some.features(721.0, layer, "text")

    weights = [0.9, 0.0, 0.45, 0.0]
    with inject(of(net), whole, weight=lambda step, steps: weights[step]):
        expected = run(net, seed=1, timesteps=timesteps)
    with inject(of(net), some):  # the paper's weights, by the run's steps
        got = run(net, seed=1, timesteps=timesteps)
    assert torch.equal(got, expected)
    alone = run(net, seed=1, timesteps=timesteps)
    assert [torch.equal(*pair) for pair in zip(got, alone, strict=True)] == [False, True, False, True]  # fmt: skip


def test_recordings_in_one_folder_keep_their_own_features(tmp_path):
    """Oracle: the same recordings in memory."""
    net = unet(8)
    plans = [plan_of(net, steps=1, store=store) for store in (tmp_path, "device")]
    on_disk, in_memory = [], []
    for seed in (0, 1):
        for plan, into in zip(plans, (on_disk, in_memory), strict=True):
            with record(of(net), plan) as recording:
                run(net, seed=seed, timesteps=(500,))
            into.append(recording)
    for layer in plans[0].layers:
        features = [
            [r.features(500.0, layer, "text") for r in kind] for kind in (on_disk, in_memory)
        ]
        assert all(map(torch.equal, *features))
        assert not torch.equal(*features[0])


def test_what_does_not_match_the_recording_is_refused_by_name():
    net = unet(8)
    with record(of(net), plan_of(net)) as recording:
        run(net)

    def again(**how):
        passes, branches = how.pop("passes", {}), how.pop("branches", PIX2PIX_BRANCHES)
        with inject(of(net, branches), recording, **how):
            run(net, **passes)

    with pytest.raises(ValueError, match="timestep: got 980, recorded are 981, 481"):
        again(passes={"timesteps": (980,)})
    with pytest.raises(
        ValueError, match="branches: recorded are text, image, the editor has uncond, txt"
    ):
        again(branches=("uncond", "txt"))
    with pytest.raises(ValueError, match=r"batch: got 2 rows, expected 3: 1 views in 3 branches"):
        again(passes={"rows": 2})
    with pytest.raises(
        ValueError, match=r"size: the recording has \(3, 4\) features, the target \(4, 4\)"
    ):
        again(passes={"size": (8, 8)})
    with pytest.raises(ValueError, match=r"weight: got 1.2"):
        again(weight=lambda step, steps: 1.2)
    with (
        pytest.raises(ValueError, match=r"latent_size: got latents of \(8, 8\), planned \(6, 8\)"),
        record(of(net), plan_of(net)),
    ):
        run(net, size=(8, 8))
    with (
        pytest.raises(ValueError, match="batch: got 2 rows, expected 3"),
        record(of(net), plan_of(net)),
    ):
        run(net, rows=2)
    with (
        pytest.raises(ValueError, match="steps: timestep 481 is one more than the 1 planned"),
        record(of(net), plan_of(net, steps=1)),
    ):
        run(net)
    with record(of(net), plan_of(net, steps=3)) as short:
        run(net)
    with (
        pytest.raises(ValueError, match="steps: the recorded run had 2 of 3 planned steps"),
        inject(of(net), short),
    ):
        pass
    for chosen, message in (([2], "got 2"), ([-1], "got -1"), ([0.5], "got 0.5"), ([], "no step")):
        with pytest.raises(ValueError, match=f"chosen: .*{message}"):
            plan_of(net, chosen=chosen)
    with (
        pytest.raises(ValueError, match="keep: got 'control'"),
        record(of(net), plan_of(net, keep=("control",))),
    ):
        pass
    for store in ("gpu", "disk", "a/folder"):  # no word is taken for a folder's name
        with pytest.raises(ValueError, match=f"store: got '{store}', expected 'device', 'cpu' or"):
            plan_of(net, store=store)
    with pytest.raises(ValueError, match="branch: got 'uncond'"):
        recording.features(981.0, recording.plan.layers[0], "uncond")


def loud_plan(net, dtype):
    """A recording of features beyond float16's range."""
    for name, module in net.named_modules():
        if name.endswith("attn1") and name.startswith("up_blocks"):
            module.to_out[0].weight.data *= 1e7
    return plan_of(net, dtype=dtype)


@pytest.mark.door
@pytest.mark.parametrize("store", ["device", "cpu", "disk"])
def test_a_feature_beyond_float16_is_refused_by_layer_step_and_type(store, tmp_path):
    net = unet(8)
    place = tmp_path if store == "disk" else store
    plan = loud_plan(net, torch.float16)
    plan = RecordingPlan(plan.layers, SIZE, plan.keep, 2, dtype=torch.float16, store=place)
    said = r"step 0 \(timestep 981\) of up_blocks.* beyond float16's 65504; record in bfloat16"
    with pytest.raises(ValueError, match=said), record(of(net), plan):
        run(net)


def test_bfloat16_holds_features_beyond_float16_and_rounds_them_once():
    """Oracle: torch's own conversion of a recording in float32."""
    net = unet(8)
    exact, rounded = (loud_plan_once(net, dtype) for dtype in (torch.float32, torch.bfloat16))
    with record(of(net), exact) as whole:
        run(net)
    with record(of(net), rounded) as half:
        run(net)
    largest = 0.0
    for layer in exact.layers:
        one, other = (r.features(981, layer, "text") for r in (whole, half))
        assert torch.equal(one.bfloat16(), other)
        largest = max(largest, float(one.abs().max()))
    assert largest > 65504


def loud_plan_once(net, dtype):
    if not hasattr(net, "made_loud"):
        net.made_loud = True
        return loud_plan(net, dtype)
    return plan_of(net, dtype=dtype)


def nothing(net):
    """No pass of the UNet at all."""


def past_its_hooks(net):
    x, text = torch.zeros(3, net.config.in_channels, *SIZE), torch.zeros(3, 5, 32)
    net.forward(x, torch.tensor(981), encoder_hidden_states=text)


def of_a_copy(net):
    run(unet(8), timesteps=(981,))


def with_another_forward(net):
    block = net.up_blocks[0].attentions[0].transformer_blocks[0]
    attention = block.attn1
    block.attn1 = torch.nn.Identity()
    block.attn1.forward = lambda x, **_: attention.forward(x)
    run(net, timesteps=(981,))


@pytest.mark.door
@pytest.mark.parametrize(
    ("call", "said"),
    [
        (nothing, "no pass went through this network"),
        (past_its_hooks, r"call network\(\.\.\.\), not network\.forward"),
        (of_a_copy, "hand over the module that the pipeline calls, not a copy"),
        (with_another_forward, "not called in any pass; its forward was replaced"),
    ],
)
def test_what_keeps_hooks_from_running_is_an_error_that_names_it(call, said):
    net = unet(8)
    plan = plan_of(net, steps=1)
    with record(of(net), plan) as recording:
        run(net, timesteps=(981,))
    for context in (
        record(of(net), plan),
        inject(of(net), recording, warps=[None]),
    ):
        with pytest.raises(RuntimeError, match=said), context:
            call(net)


@pytest.mark.door
def test_a_compiled_unet_is_named_as_such():
    """torch's own attribute of a module that was compiled in place."""
    net = unet(8)
    net.compile(backend="eager")
    net._compiled_call_impl = lambda *args, **kwargs: None  # what the compiled graph would give
    said = pytest.raises(RuntimeError, match="the network is compiled; use it before torch.compile")
    with said, record(of(net), plan_of(net, steps=1)):
        net()


@pytest.mark.door
def test_an_error_inside_the_block_is_not_covered_by_another():
    net = unet(8)
    with pytest.raises(ZeroDivisionError), record(of(net), plan_of(net)):
        1 / 0  # noqa: B018
