"""Small random editors with joint attention, in diffusers' own classes, and their pipelines.

Texts are random embeddings of their words, given to editor and pipeline alike.
"""

import hashlib

import diffusers
import numpy as np
import torch
from diffusers import FlowMatchEulerDiscreteScheduler

from attnwarp.editing.editors import kinds

diffusers.utils.logging.set_verbosity_error()
diffusers.utils.logging.disable_progress_bar()

# Imported here, so that no test waits for it.
for _name in ("Flux2KleinPipeline", "FluxKontextPipeline", "QwenImageEditPipeline"):
    getattr(diffusers, _name)

NAMES = ("klein", "kontext", "qwen", "qwen-plus", "sd3")
PIPELINES = {
    "klein": "Flux2KleinPipeline",
    "kontext": "FluxKontextPipeline",
    "qwen": "QwenImageEditPipeline",
    "qwen-plus": "QwenImageEditPlusPipeline",
    "sd3": "StableDiffusion3Img2ImgPipeline",
}
BLOCKS = {
    "down_block_types": ("DownEncoderBlock2D",), "up_block_types": ("UpDecoderBlock2D",), "block_out_channels": (4,),
    "layers_per_block": 1, "norm_num_groups": 1, "use_quant_conv": False, "use_post_quant_conv": False,
}  # fmt: skip
KL = {**BLOCKS, "shift_factor": 0.0609, "scaling_factor": 1.5035}
NETWORKS = {
    "klein": {
        "in_channels": 4, "num_layers": 2, "num_single_layers": 2, "attention_head_dim": 16, "num_attention_heads": 2,
        "joint_attention_dim": 16, "axes_dims_rope": [4, 4, 4, 4], "guidance_embeds": False, "timestep_guidance_channels": 256,
    },
    "kontext": {
        "in_channels": 4, "num_layers": 2, "num_single_layers": 2, "attention_head_dim": 16, "num_attention_heads": 2,
        "joint_attention_dim": 32, "pooled_projection_dim": 32, "axes_dims_rope": [4, 4, 8], "guidance_embeds": True,
    },
    "qwen": {
        "patch_size": 2, "in_channels": 16, "out_channels": 4, "num_layers": 2, "attention_head_dim": 16,
        "num_attention_heads": 3, "joint_attention_dim": 16, "axes_dims_rope": (8, 4, 4),
    },
    "sd3": {
        "sample_size": 32, "patch_size": 1, "in_channels": 4, "num_layers": 2, "attention_head_dim": 8,
        "num_attention_heads": 4, "caption_projection_dim": 32, "joint_attention_dim": 32, "pooled_projection_dim": 64,
        "out_channels": 4, "dual_attention_layers": (0,), "qk_norm": "rms_norm",
    },
}  # fmt: skip
NETWORKS["qwen-plus"] = {**NETWORKS["qwen"], "zero_cond_t": True}
SHIFTED = {"use_dynamic_shifting": True, "base_shift": 0.5, "max_shift": 1.15}
SCHEDULES = {
    "klein": SHIFTED,
    "kontext": SHIFTED,
    "qwen": {**SHIFTED, "max_shift": 0.9, "shift_terminal": 0.02},
    "qwen-plus": {**SHIFTED, "max_shift": 0.9, "shift_terminal": 0.02},
    "sd3": {"shift": 3.0},
}
SIDE = {"klein": 2, "kontext": 2, "qwen": 8, "qwen-plus": 8, "sd3": 1}
"""Side of a token in px."""
TEXT = 5
"""Tokens of a text; the negative prompt of an editor with two passes has two fewer."""
STEPS = {"klein": 3, "kontext": 3, "qwen": 3, "qwen-plus": 3, "sd3": 3}


def vae(name):
    torch.manual_seed(1)
    if name == "klein":
        coder = diffusers.AutoencoderKLFlux2(**BLOCKS, latent_channels=1)
        # Untrained statistics are 0 and 1, which would test nothing.
        coder.bn.running_mean.copy_(torch.tensor([0.1, -0.2, 0.3, 0.05]))
        coder.bn.running_var.copy_(torch.tensor([0.5, 2.0, 1.5, 0.8]))
        return coder
    if name in ("qwen", "qwen-plus"):
        return diffusers.AutoencoderKLQwenImage(
            base_dim=24, z_dim=4, dim_mult=[1, 2, 4], num_res_blocks=1, temperal_downsample=[False, True],
            latents_mean=[0.1, -0.3, 0.0, 0.2], latents_std=[0.7, 1.2, 1.0, 1.6],
        )  # fmt: skip
    return diffusers.AutoencoderKL(**KL, latent_channels=1 if name == "kontext" else 4)


def network(name, **changes):
    torch.manual_seed(0)
    kind = kinds()[PIPELINES[name]].networks["transformer"]
    net = getattr(diffusers, kind)(**{**NETWORKS[name], **changes})
    with torch.no_grad():  # norms and gates start at plain values, which would test nothing
        for parameter in net.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return net.eval()


def parts(name, dtype=torch.float32, **changes):
    encoders = {
        part: None for part in kinds()[PIPELINES[name]].networks if part.startswith("text_encoder")
    }
    empty = {**encoders, **{part.replace("text_encoder", "tokenizer"): None for part in encoders}}
    if name.startswith("qwen"):
        empty["processor"] = None
    return {
        "transformer": network(name, **changes).to(dtype), "vae": vae(name).to(dtype).eval(),
        "scheduler": FlowMatchEulerDiscreteScheduler(**SCHEDULES[name]), **empty,
    }  # fmt: skip


def random(words, *shape):
    """Normal numbers of its own for each text."""
    seed = int.from_bytes(hashlib.sha256(words.encode()).digest()[:4], "big")
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def embedded(name, words, count=TEXT):
    """Embeddings of a text: a row of the arguments that the network takes."""
    told = NETWORKS[name]
    rows = {"encoder_hidden_states": random(words, 1, count, told["joint_attention_dim"])}
    if "pooled_projection_dim" in told:
        rows["pooled_projections"] = random(words + "!", 1, told["pooled_projection_dim"])
    return rows


def text_count(name, words):
    return TEXT if name in ("sd3", "kontext") or words != "" else TEXT - 2


def editor(name, dtype=torch.float32, changes=None, **settings):
    """An editor whose texts are :func:`embedded`."""
    kind = kinds()[PIPELINES[name]]

    class Told(kind):
        def embed(self, words, pictures):
            rows = embedded(name, words, text_count(name, words))
            views = len(pictures[0])
            return {k: v.to(dtype).expand(views, *v.shape[1:]) for k, v in rows.items()}

    settings = (
        {"negative_prompt": "", **settings} if "negative_prompt" in kind.options else settings
    )
    return Told(**parts(name, dtype, **(changes or {})), **settings)


def picture(name, h=6, w=8, seed=0):
    """A picture of h x w tokens in 8-bit values, which every pipeline reads as they are."""
    side = SIDE[name]
    levels = np.random.default_rng(seed).integers(0, 256, (h * side, w * side, 3))
    return (levels / 255).astype(np.float32)


CHAT = "{% for message in messages %}<|im_start|>{{ message.content }}{% endfor %}"


def byte_tokenizer(kind, **settings):
    """A tokenizer of every byte."""
    from tokenizers.pre_tokenizers import ByteLevel

    letters = sorted(ByteLevel.alphabet())
    special = ["<|im_start|>", "<|endoftext|>"]
    return kind(
        vocab={letter: i for i, letter in enumerate([*letters, *special])}, merges=[], **settings
    )


def klein_folder(folder, *, distilled=True):
    """A folder of a tiny FLUX.2 klein, as diffusers' saver writes it."""
    from transformers import Qwen2Tokenizer, Qwen3Config, Qwen3ForCausalLM

    words = byte_tokenizer(Qwen2Tokenizer, pad_token="<|endoftext|>")
    words.chat_template = CHAT
    torch.manual_seed(2)
    reader = Qwen3ForCausalLM(
        Qwen3Config(
            vocab_size=len(words), hidden_size=8, intermediate_size=8, num_hidden_layers=28, num_attention_heads=2,
            num_key_value_heads=1, head_dim=4, max_position_embeddings=512,
        )
    )  # fmt: skip
    changes = {"joint_attention_dim": 24}
    told = {**parts("klein", **changes), "text_encoder": reader, "tokenizer": words}
    pipe = diffusers.Flux2KleinPipeline(**told, is_distilled=distilled)
    pipe.save_pretrained(folder)
    return pipe
