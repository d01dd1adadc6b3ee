import pytest
import torch
from diffusers import ControlNetModel
from tiny_baselines import QUICK
from tiny_editors import parts, unet
from tiny_scenes import cameras, pictures, splats
from torch_threads import on_one_thread

from attnwarp.baselines import METHODS
from attnwarp.editing.controlnet import DepthControlNet
from attnwarp.editing.pix2pix import InstructPix2Pix

one_thread = pytest.fixture(on_one_thread, autouse=True, scope="package")


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
    """Of pictures."""
    net = unet(8, **ONE_LEVEL)
    loud(net)
    return InstructPix2Pix(net, **parts(), text_guidance=3.0)


@pytest.fixture(scope="session")
def depth_editor():
    """Of depth maps."""
    net = unet(4, **ONE_LEVEL)
    torch.manual_seed(1)
    control = ControlNetModel.from_unet(net, conditioning_embedding_out_channels=(8, 8)).eval()
    for block in (*control.controlnet_down_blocks, control.controlnet_mid_block):
        torch.nn.init.normal_(block.weight, std=0.1)  # from_unet leaves them zero
    torch.nn.init.normal_(control.controlnet_cond_embedding.conv_out.weight, std=0.1)
    loud(net)
    loud(control)
    return DepthControlNet(net, **parts(), controlnet=control, guidance=3.0)


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
