"""Short runs of the methods, fixtures for them, and what counts and compares them."""

import numpy as np
import pytest
import torch
from diffusers import ControlNetModel
from tiny_editors import parts, unet
from tiny_scenes import cameras, pictures, splats

from attnwarp.editing.editors.controlnet import DepthControlNet
from attnwarp.editing.editors.pix2pix import InstructPix2Pix
from attnwarp.methods import (
    METHODS,
    AttentionWarpingSettings,
    ByViewSettings,
    CorrespondingSettings,
    DGESettings,
    FusedSettings,
    GaussCtrlSettings,
    GuidedSettings,
    IGS2GSSettings,
    WarpedReferenceSettings,
)

QUICK = {
    "attention_warping": AttentionWarpingSettings(
        steps=2, stages=2, views_per_stage=1, iterations=2, perceptual=0.0, batch=2
    ),
    "by_view": ByViewSettings(steps=2, iterations=3, perceptual=0.0, batch=2),
    "igs2gs": IGS2GSSettings(steps=2, iterations=5, every=3),
    "dge": DGESettings(steps=2, iterations=4, every=2, batch=2, views=2, perceptual=0.0),
    "gaussctrl": GaussCtrlSettings(steps=2, iterations=3, references=2, batch=2),
    "corresponding": CorrespondingSettings(steps=2, iterations=3, perceptual=0.0, batch=2),
    "fused": FusedSettings(steps=2, iterations=3, perceptual=0.0),
    "guided": GuidedSettings(steps=2, iterations=3, perceptual=0.0),
    "warped_reference": WarpedReferenceSettings(steps=2, iterations=3, perceptual=0.0, batch=2),
}


def rows_of(network, call):
    """Rows that go through the network, and the call's result."""
    rows = []

    def count(module, args, kwargs):
        rows.append((args[0] if args else kwargs["sample"]).shape[0])

    handle = network.register_forward_pre_hook(count, with_kwargs=True)
    try:
        return rows, call()
    finally:
        handle.remove()


def close(a, b):
    """Equal but for the last bits of float32, which may round to another of 256 levels."""
    return np.abs(a.astype(int) - b).max() <= 1


def loud(network):
    """With random weights attention is a faint mean of all tokens; it is made to look and to
    count. A factor of 10 would turn the last bits of float32 into other pictures.
    """
    for name, module in network.named_modules():
        if name.endswith(".attn1"):
            for part in (module.to_q, module.to_k, module.to_v, module.to_out[0]):
                part.weight.data *= 4


ONE_LEVEL = {
    "block_out_channels": (16,),
    "down_block_types": ("CrossAttnDownBlock2D",),
    "up_block_types": ("CrossAttnUpBlock2D",),
}


@pytest.fixture(scope="session")
def editor():
    """Editor of pictures."""
    net = unet(8, **ONE_LEVEL)
    loud(net)
    return InstructPix2Pix(net, **parts(halvings=2), text_guidance=3.0)


@pytest.fixture(scope="session")
def depth_editor():
    """Editor of depth maps."""
    net = unet(4, **ONE_LEVEL)
    torch.manual_seed(1)
    control = ControlNetModel.from_unet(net, conditioning_embedding_out_channels=(8,) * 3).eval()
    for block in (*control.controlnet_down_blocks, control.controlnet_mid_block):
        torch.nn.init.normal_(block.weight, std=0.1)  # from_unet leaves them zero
    torch.nn.init.normal_(control.controlnet_cond_embedding.conv_out.weight, std=0.1)
    loud(net)
    loud(control)
    return DepthControlNet(net, **parts(halvings=2), controlnet=control, text_guidance=3.0)


@pytest.fixture(scope="session")
def scene():
    """Splats, cameras, and pictures before the edit."""
    model, views = splats(30), cameras(3)
    return model, views, pictures(model, views)


@pytest.fixture
def run(scene, editor, depth_editor):
    """Run a method on the scene with its kind of editor."""

    def call(name, settings=None, model_and_views=None, words="a bear", **options):
        model, views, images = model_and_views or scene
        kind = depth_editor if name == "gaussctrl" else editor
        chosen = QUICK[name] if settings is None else settings
        return METHODS[name](model, views, images, kind, words, chosen, **options)

    return call
