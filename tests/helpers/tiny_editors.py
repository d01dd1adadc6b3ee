"""Small random diffusion models in diffusers' own classes, and folders of them as its savers write them."""

import diffusers
import torch
from diffusers import (
    AutoencoderKL,
    ControlNetModel,
    DDIMScheduler,
    StableDiffusionControlNetPipeline,
    StableDiffusionInstructPix2PixPipeline,
    UNet2DConditionModel,
)
from tiny_models import tokenizer, tokens
from transformers import CLIPTextConfig, CLIPTextModel

diffusers.utils.logging.set_verbosity_error()
diffusers.utils.logging.disable_progress_bar()

UNET = {
    "out_channels": 4,
    "block_out_channels": (16, 32),
    "layers_per_block": 1,
    "down_block_types": ("CrossAttnDownBlock2D", "DownBlock2D"),
    "up_block_types": ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D"),
    "cross_attention_dim": 32,
    "attention_head_dim": 2,  # heads, whatever its name
    "norm_num_groups": 8,
    "sample_size": 8,
}


def unet(in_channels=4, seed=0, **changes):
    torch.manual_seed(seed)
    return UNet2DConditionModel(**{**UNET, "in_channels": in_channels, **changes}).eval()


def parts(seed=0, halvings=1):
    """Autoencoder, text encoder, tokenizer and scheduler; each halving of a picture's side spares
    the network three quarters of its work.
    """
    torch.manual_seed(seed)
    levels = halvings + 1
    vae = AutoencoderKL(
        block_out_channels=(8, *(16,) * halvings), down_block_types=("DownEncoderBlock2D",) * levels, up_block_types=("UpDecoderBlock2D",) * levels,
        norm_num_groups=4, latent_channels=4, scaling_factor=0.4,
    ).eval()  # fmt: skip
    vocab, _ = tokens()
    text = CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(vocab), hidden_size=32, intermediate_size=37, num_hidden_layers=2, num_attention_heads=4,
            max_position_embeddings=24, bos_token_id=len(vocab) - 2, eos_token_id=len(vocab) - 1, pad_token_id=1,
        )
    ).eval()  # fmt: skip
    words = tokenizer()
    words.model_max_length = 24
    scheduler = DDIMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", clip_sample=False, set_alpha_to_one=False, steps_offset=1,
    )  # fmt: skip
    return {"vae": vae, "text_encoder": text, "tokenizer": words, "scheduler": scheduler}


def nearest_steps(alphas, published):
    """The steps at which as much of a picture is left as at Stable Diffusion's: the definition in Python's float64."""
    low, high = 0.00085**0.5, 0.012**0.5
    signal, product = [], 1.0
    for k in range(1000):
        product *= 1 - (low + (high - low) * k / 999) ** 2
        signal.append(product)
    own = [float(alpha) for alpha in alphas]
    return [min(range(len(own)), key=lambda k: abs(own[k] - signal[step])) for step in published]


NO_CHECKER = {"safety_checker": None, "feature_extractor": None, "requires_safety_checker": False}


def pix2pix(halvings=1):
    own = parts(halvings=halvings)
    pipe = StableDiffusionInstructPix2PixPipeline(unet=unet(8), **own, **NO_CHECKER)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def controlnet(halvings=1):
    base = unet(4)
    torch.manual_seed(1)
    control = ControlNetModel.from_unet(
        base, conditioning_embedding_out_channels=(8,) * (halvings + 1)
    ).eval()
    for block in (*control.controlnet_down_blocks, control.controlnet_mid_block):
        torch.nn.init.normal_(
            block.weight, std=0.1
        )  # from_unet leaves them zero, which would test nothing
    torch.nn.init.normal_(control.controlnet_cond_embedding.conv_out.weight, std=0.1)
    own = parts(halvings=halvings)
    pipe = StableDiffusionControlNetPipeline(unet=base, controlnet=control, **own, **NO_CHECKER)
    pipe.set_progress_bar_config(disable=True)
    return pipe
