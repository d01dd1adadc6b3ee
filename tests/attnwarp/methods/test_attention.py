"""Oracle: attention, matches and their average written out in float64, token by token, from the inputs of every layer."""

import functools
from contextlib import contextmanager

import numpy as np
import pytest
import tiny_editors
import torch
from drawn_lines import drawn_distances

from attnwarp import Camera
from attnwarp.methods import matching
from attnwarp.methods.algorithms.dge import by_angle
from attnwarp.methods.attention import aligned, self_attention
from attnwarp.methods.epipolar import line_distances
from attnwarp.methods.matching import key_views, matches

SIDE = 8  # of the latents; half of it in the lower layers


@pytest.fixture(scope="module")
def network():
    net = tiny_editors.unet(8).double().requires_grad_(False)
    for module in layers(net).values():  # with random weights attention is a faint mean
        for part in (module.to_q, module.to_k, module.to_v, module.to_out[0]):
            part.weight *= 4
    return net


def layers(network):
    return {name: module for name, module in network.named_modules() if name.endswith(".attn1")}


@contextmanager
def watched(network):
    """Inputs and outputs of every self-attention, by name."""
    calls = {}

    def note(name):
        def hook(module, args, kwargs, output):
            calls[name] = (args[0] if args else kwargs["hidden_states"]).numpy(), output.numpy()

        return hook

    handles = [
        module.register_forward_hook(note(name), with_kwargs=True)
        for name, module in layers(network).items()
    ]
    yield calls
    for handle in handles:
        handle.remove()


def forward(network, rows, seed=0):
    random = torch.Generator().manual_seed(seed)
    channels = network.config.in_channels
    x = torch.randn((rows, channels, SIDE, SIDE), generator=random, dtype=torch.float64)
    text = torch.randn((rows, 5, 32), generator=random, dtype=torch.float64)
    with torch.no_grad():
        return network(x, 500, encoder_hidden_states=text).sample


def attention(module, query_tokens, key_tokens):
    """(L, C): softmax(q k^T / sqrt(d)) v by head, projected."""
    q, k, v = (
        tokens @ part.weight.numpy().T
        for part, tokens in (
            (module.to_q, query_tokens), (module.to_k, key_tokens), (module.to_v, key_tokens),
        )
    )  # fmt: skip
    d = q.shape[1] // module.heads
    heads = []
    for h in range(module.heads):
        part = slice(h * d, (h + 1) * d)
        scores = np.exp(q[:, part] @ k[:, part].T / np.sqrt(d))
        heads.append(scores / scores.sum(1, keepdims=True) @ v[:, part])
    out = module.to_out[0]
    return np.concatenate(heads, axis=1) @ out.weight.numpy().T + out.bias.numpy()


def test_gaussctrls_attention_is_its_formula_in_every_layer(network):
    references, views, branches = 2, 3, 2
    with self_attention(network, aligned(references, 0.6, branches)), watched(network) as calls:
        forward(network, branches * views)
    assert len(calls) == len(layers(network)) > 2
    for name, module in layers(network).items():
        tokens, output = calls[name]
        for row in range(branches * views):
            first = row // views * views  # of the row's branch
            means = [attention(module, tokens[row], tokens[first + r]) for r in range(references)]
            expected = 0.6 * attention(module, tokens[row], tokens[row]) + 0.4 * np.mean(means, 0)
            assert np.abs(output[row] - expected).max() < 1e-9 * max(1, np.abs(expected).max())
    plain = forward(network, branches * views)
    with self_attention(network, aligned(references, 0.0, branches)):
        assert (forward(network, branches * views) - plain).abs().max() > 1e-3


def ring():
    """Three views and two key cameras, at one of the views and beyond another."""
    size = {"width": SIDE, "height": SIDE, "fov_y": 50}
    places = [(3 * np.sin(a), -3 * np.cos(a), z) for a, z in ((0, 0), (0.4, 0.3), (1.0, -0.2))]
    views = [Camera.look_at(place, (0.1, 0, 0), **size) for place in places]
    beyond = Camera.look_at((3 * np.sin(1.6), -3 * np.cos(1.6), 0.1), (0, 0, 0), **size)
    return views, [views[0], beyond]


@functools.cache
def far_from_line(view, key, size, radius):
    return drawn_distances(view, key, size) > radius


def matched(tokens, key_tokens, key_outputs, views, keys, size, nearest, radius):
    """(3, V, L, C) by a loop over tokens; the image branch, the second, is matched."""
    result = np.zeros_like(tokens)
    for v, view in enumerate(views):
        apart = [np.linalg.norm(view.position - key.position) for key in keys]
        chosen = sorted(range(len(keys)), key=lambda k: apart[k])[:nearest]
        weights = [1.0]
        if len(chosen) == 2:
            d1, d2 = (apart[k] for k in chosen)
            first = 1 / (1 + np.exp(-d2 / (d1 + d2)))
            weights = [first, 1 - first]
        for key, weight in zip(chosen, weights, strict=True):
            for i, a in enumerate(tokens[1, v]):
                candidates = range(tokens.shape[2])
                if radius is not None and apart[key] > 0:
                    far = far_from_line(view, keys[key], size, radius)[i]
                    candidates = [j for j in candidates if not far[j]] or candidates
                b = key_tokens[1, key, list(candidates)]
                cosines = b @ a / np.linalg.norm(a) / np.linalg.norm(b, axis=1)
                best = candidates[int(np.argmax(cosines))]
                result[:, v, i] += weight * key_outputs[:, key, best]
    return result


@pytest.mark.parametrize(("nearest", "radius"), [(2, 1.0), (1, None)])
def test_dges_attention_is_a_loop_over_tokens_in_every_layer(network, nearest, radius):
    views, keys = ring()
    branches = ("text", "image", "uncond")
    with key_views(network, branches, (SIDE, SIDE), radius) as attention_of:
        with attention_of.key_pass(), watched(network) as of_keys:
            forward(network, 6, seed=1)
        with attention_of.view_pass(views, keys, nearest), watched(network) as of_views:
            forward(network, 9, seed=2)
    excluded = 0
    for name, module in layers(network).items():
        tokens, outputs = of_keys[name]
        for row in range(6):  # two key views look at the tokens of both, branch by branch
            both = tokens[row // 2 * 2 : row // 2 * 2 + 2].reshape(-1, tokens.shape[2])
            expected = attention(module, tokens[row], both)
            assert np.abs(outputs[row] - expected).max() < 1e-9 * max(1, np.abs(expected).max())
        own, result = of_views[name]
        side = round(own.shape[1] ** 0.5)
        split = [values.reshape(3, -1, *values.shape[1:]) for values in (own, tokens, outputs)]
        expected = matched(*split, views, keys, (side, side), nearest, radius)
        assert (
            np.abs(result.reshape(expected.shape) - expected).max() < 1e-9 * np.abs(outputs).max()
        )
        anywhere = matched(*split, views, keys, (side, side), nearest, None)
        excluded += (np.abs(anywhere - expected).max(axis=(0, 3)) > 0).sum()
    assert (excluded > 50) == (radius is not None)


def test_layers_of_one_size_share_the_distances_from_a_views_lines(network, monkeypatch):
    asked = []

    def watched_distances(view, key, size):
        asked.append((id(view), id(key), size))
        return line_distances(view, key, size)

    monkeypatch.setattr(matching, "line_distances", watched_distances)
    views, keys = ring()
    with key_views(network, ("text",), (SIDE, SIDE), 1.0) as attention_of:
        with attention_of.key_pass():
            forward(network, 2)
        with attention_of.view_pass(views, keys, 2):
            forward(network, 3)
    sizes = {(side, side) for side in (SIDE, SIDE // 2)}
    assert len(layers(network)) > len(sizes)
    assert sorted(asked) == sorted((id(v), id(k), s) for v in views for k in keys for s in sizes)


def test_a_match_is_the_best_of_the_pairs_that_count_and_of_all_where_none_does():
    random = np.random.default_rng(0)
    tokens, keys = random.normal(size=(20, 6)), random.normal(size=(30, 6))
    excluded = random.random((20, 30)) < 0.8
    excluded[3] = True
    result = matches(*(torch.from_numpy(value) for value in (tokens, keys, excluded)))
    for i in range(20):
        cosines = [
            tokens[i] @ keys[j] / np.linalg.norm(tokens[i]) / np.linalg.norm(keys[j])
            for j in range(30)
        ]
        allowed = [j for j in range(30) if not excluded[i, j]] or range(30)
        assert result[i] == max(allowed, key=lambda j: cosines[j])


def test_a_network_is_as_before_once_a_method_is_done(network):
    before, processors = forward(network, 6), dict(network.attn_processors)
    with self_attention(network, aligned(1, 0.6, 3)):
        pass
    with (
        pytest.raises(RuntimeError, match="stopped"),
        key_views(network, ("text",), (SIDE, SIDE), 1.0),
    ):
        raise RuntimeError("stopped")
    assert network.attn_processors == processors
    assert torch.equal(forward(network, 6), before)
    with key_views(network, ("text",), (SIDE, SIDE), 1.0):  # outside of a pass
        assert torch.equal(forward(network, 6), before)


def test_cameras_on_a_ring_are_sorted_all_the_way_round():
    random = np.random.default_rng(3)
    angles = random.uniform(0, 2 * np.pi, 30)
    view = {"width": 8, "height": 8, "fov_y": 60}
    ring = [Camera.look_at((np.cos(a), np.sin(a), 0.3), (0, 0, 0.3), **view) for a in angles]
    order = by_angle(ring, range(30))
    assert sorted(order) == list(range(30))
    assert order[0] == np.argmin(np.cos(angles))
    steps = np.diff(angles[order])
    steps = (steps + np.pi) % (2 * np.pi) - np.pi
    assert (np.sign(steps) == np.sign(steps[0])).all()
