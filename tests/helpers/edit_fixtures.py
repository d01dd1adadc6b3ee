"""Fixtures of edits: an editor whose attention counts, and a scene; imported by conftests."""

import pytest
from tiny_editors import pix2pix
from tiny_scenes import cameras, pictures, splats
from torch_threads import on_one_thread

from attnwarp.editing.editors.pix2pix import InstructPix2Pix

one_thread = pytest.fixture(on_one_thread, autouse=True, scope="package")


@pytest.fixture(scope="session")
def editor():
    pipe = pix2pix(halvings=2)
    # With random weights attention is a faint mean of all tokens; it is made to look and to count.
    for name, module in pipe.unet.named_modules():
        if name.startswith("up_blocks") and name.endswith((".attn1", ".attn2")):
            module.to_q.weight.data *= 10
            module.to_k.weight.data *= 10
            module.to_v.weight.data *= 10
            module.to_out[0].weight.data *= 10
    return InstructPix2Pix(
        pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler, text_guidance=3.0
    )


@pytest.fixture(scope="session")
def scene():
    """Splats, cameras, and pictures before the edit."""
    model, views = splats(), cameras()
    return model, views, pictures(model, views)
