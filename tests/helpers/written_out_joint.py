"""A network of one double and one single block with joint attention, written out in float64.

Nothing of diffusers runs here: weights are read by name, formulas are those of the papers (Esser et
al. 2024; Dehghani et al. 2023 for the parallel block; Su et al. 2021 for the turning).
"""

import math

import torch


def linear(w, name, x):
    bias = w.get(f"{name}.bias")
    y = x @ w[f"{name}.weight"].T
    return y if bias is None else y + bias


def silu(x):
    return x / (1 + torch.exp(-x))


def gelu(x):
    return 0.5 * x * (1 + torch.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))


def layer_norm(x):
    centred = x - x.mean(-1, keepdim=True)
    return centred / torch.sqrt(centred.square().mean(-1, keepdim=True) + 1e-6)


def rms_norm(x, weight):
    return x / torch.sqrt(x.square().mean(-1, keepdim=True) + 1e-6) * weight


def waves(value, width=256):
    """(1, width) cosines then sines of a number."""
    angles = value * torch.exp(-math.log(10000) * torch.arange(width // 2).double() / (width // 2))
    return torch.cat([angles.cos(), angles.sin()])[None]


def mlp(w, name, x):
    return linear(w, f"{name}.linear_2", silu(linear(w, f"{name}.linear_1", x)))


def turned(x, ids, axes):
    """Turn (S, heads, D) pairs of channels by the (S, axes) positions."""
    angles = torch.cat(
        [
            ids[:, k : k + 1] * 10000 ** (-torch.arange(0, d, 2).double() / d)
            for k, d in enumerate(axes)
        ],
        dim=1,
    )[:, None]
    a, b = x[..., 0::2], x[..., 1::2]
    pairs = (a * angles.cos() - b * angles.sin(), a * angles.sin() + b * angles.cos())
    return torch.stack(pairs, dim=-1).flatten(-2)


def attention(q, k, v):
    """(S, heads, D) each, to (S, heads D)."""
    scores = torch.einsum("qhd,khd->hqk", q, k) / math.sqrt(q.shape[-1])
    return torch.einsum("hqk,khd->qhd", scores.softmax(-1), v).flatten(1)


def velocity(w, config, image, text, pooled, ids, share, guidance, change):
    """(S, C) velocity of a network; ``change(place, tokens)`` replaces (image's rows, D) features.

    Args:
        image: (S, C) tokens of the picture and of its reference.
        ids: (T + S, 3) positions.
        change: function of "double" or "single" and all (S, D) rows of image and reference.
    """
    heads, axes, count = config["num_attention_heads"], config["axes_dims_rope"], len(text)

    def split(x):
        return x.unflatten(-1, (heads, -1))

    time = mlp(w, "time_text_embed.timestep_embedder", waves(1000 * share))
    time = time + mlp(w, "time_text_embed.guidance_embedder", waves(1000 * guidance))
    time = silu(time + mlp(w, "time_text_embed.text_embedder", pooled))
    x, c = linear(w, "x_embedder", image), linear(w, "context_embedder", text)

    at = "transformer_blocks.0"
    parts = linear(w, f"{at}.norm1.linear", time).chunk(6, -1)
    words = linear(w, f"{at}.norm1_context.linear", time).chunk(6, -1)
    nx, nc = layer_norm(x) * (1 + parts[1]) + parts[0], layer_norm(c) * (1 + words[1]) + words[0]
    joined = []
    for role, added in (("q", "add_q_proj"), ("k", "add_k_proj"), ("v", "add_v_proj")):
        own, told = (
            split(linear(w, f"{at}.attn.to_{role}", nx)),
            split(linear(w, f"{at}.attn.{added}", nc)),
        )
        if role != "v":
            own = rms_norm(own, w[f"{at}.attn.norm_{role}.weight"])
            told = rms_norm(told, w[f"{at}.attn.norm_added_{role}.weight"])
        joined.append(torch.cat([told, own]))
    q, k, v = joined
    out = attention(turned(q, ids, axes), turned(k, ids, axes), v)
    out = torch.cat([out[:count], change("double", out[count:])])
    x = x + parts[2] * linear(w, f"{at}.attn.to_out.0", out[count:])
    c = c + words[2] * linear(w, f"{at}.attn.to_add_out", out[:count])
    for stream, mods, name in ((x, parts, "ff"), (c, words, "ff_context")):
        hidden = layer_norm(stream) * (1 + mods[4]) + mods[3]
        hidden = gelu(linear(w, f"{at}.{name}.net.0.proj", hidden))
        # In place, so that both names see it.
        stream += mods[5] * linear(w, f"{at}.{name}.net.2", hidden)

    at, both = "single_transformer_blocks.0", torch.cat([c, x])
    shift, scale, gate = linear(w, f"{at}.norm.linear", time).chunk(3, -1)
    n = layer_norm(both) * (1 + scale) + shift
    q, k, v = (split(linear(w, f"{at}.attn.to_{role}", n)) for role in "qkv")
    q, k = (rms_norm(a, w[f"{at}.attn.norm_{role}.weight"]) for a, role in ((q, "q"), (k, "k")))
    out = attention(turned(q, ids, axes), turned(k, ids, axes), v)
    out = torch.cat([out[:count], change("single", out[count:])])
    wide = torch.cat([out, gelu(linear(w, f"{at}.proj_mlp", n))], dim=-1)
    both = both + gate * linear(w, f"{at}.proj_out", wide)

    scale, shift = linear(w, "norm_out.linear", time).chunk(2, -1)
    return linear(w, "proj_out", layer_norm(both[count:]) * (1 + scale) + shift)
