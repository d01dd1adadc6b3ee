import pytest
import torch
from tiny_editors import controlnet, pix2pix
from tiny_scenes import cameras, pictures, splats

from attnwarp.editing.controlnet import DepthControlNet
from attnwarp.editing.pix2pix import InstructPix2Pix


@pytest.fixture(autouse=True, scope="package")
def one_thread():
    """Pictures this small gain nothing from threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def loud(network):
    """With random weights attention is a faint mean of all tokens; it is made to look and to count."""
    for name, module in network.named_modules():
        if name.endswith(".attn1"):
            for part in (module.to_q, module.to_k, module.to_v, module.to_out[0]):
                part.weight.data *= 10


@pytest.fixture(scope="session")
def editor():
    """Of pictures."""
    pipe = pix2pix()
    loud(pipe.unet)
    return InstructPix2Pix(
        pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler, text_guidance=3.0
    )


@pytest.fixture(scope="session")
def depth_editor():
    """Of depth maps."""
    pipe = controlnet()
    loud(pipe.unet)
    loud(pipe.controlnet)
    names = ("unet", "vae", "text_encoder", "tokenizer", "scheduler", "controlnet")
    return DepthControlNet(*(getattr(pipe, name) for name in names), guidance=3.0)


@pytest.fixture(scope="session")
def scene():
    """Splats, cameras, and pictures before the edit."""
    model, views = splats(30), cameras(3)
    return model, views, pictures(model, views)
