"""Oracles: SciPy's rotations, values by hand."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from attnwarp import Gaussians


def splats(kind="2d", n=5, dtype=torch.float32, **changes):
    rng = np.random.default_rng(0)

    def tensor(*shape):
        return torch.from_numpy(rng.uniform(0.1, 0.9, shape)).to(dtype)

    fields = {
        "means": tensor(n, 3), "quats": tensor(n, 4), "scales": tensor(n, 2 if kind == "2d" else 3),
        "opacities": tensor(n), "sh": tensor(n, 4, 3),
    }  # fmt: skip
    return Gaussians(kind, **{**fields, **changes})


@pytest.mark.parametrize(
    ("dtype", "power"),
    # From where the squares are hardly above zero to the largest numbers.
    [(torch.float32, p) for p in (-72, -63, 0, 80, 127)]
    + [(torch.float64, p) for p in (-530, -46, 0, 46, 600, 1023)],
)
def test_rotations_are_scipys_for_quaternions_of_any_length(dtype, power):
    model = splats(dtype=dtype)
    w, x, y, z = model.quats.double().T.numpy() * 7.0
    length = 2.0 ** (power - power // 2)
    quats = model.quats * length * 2.0 ** (power // 2)
    model = dataclasses.replace(model, quats=quats)
    expected = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    error = np.abs(model.rotations().numpy() - expected).max()
    assert error < 8 * torch.finfo(dtype).eps


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_quaternions_of_ordinary_length_turn_with_the_bits_of_the_plain_formula(dtype):
    """And so do their gradients: results of fits keep their bits."""
    quats = torch.randn(500, 4, generator=torch.Generator().manual_seed(0), dtype=dtype)
    quats *= 10 ** torch.linspace(-4, 4, 500, dtype=dtype)[:, None]
    upstream = torch.randn(500, 3, generator=torch.Generator().manual_seed(1), dtype=dtype)

    def plain(q):
        w, x, y, z = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
        return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)

    def gradient(function):
        leaf = quats.clone().requires_grad_()
        result = function(leaf)
        return result, *torch.autograd.grad(result, leaf, upstream)

    def turned(leaf):
        return splats("2d", 500, dtype, quats=leaf).rotations()[:, :, 2]

    for got, expected in zip(gradient(turned), gradient(plain), strict=True):
        assert torch.equal(got, expected)


def test_selecting_keeps_rows_together_and_everything_else():
    model = splats(origin=[1.0, 2, 3])
    chosen = model.select(torch.tensor([3, 1]))
    for field in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(chosen, field), getattr(model, field)[[3, 1]])
    assert chosen.origin.tolist() == [1, 2, 3]
    assert (len(chosen), chosen.sh_degree) == (2, 1)
    assert len(model.select(torch.zeros(5, dtype=torch.bool))) == 0


def test_another_dtype_leaves_the_origin_in_float64():
    model = splats().to(torch.float64)
    assert model.means.dtype == torch.float64
    assert model.origin.dtype == np.float64


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "4d"}, "kind: got '4d', expected one of '2d', '3d'"),
        ({"quats": torch.ones(5, 3)}, r"quats: got shape \(5, 3\), expected \(5, 4\)"),
        ({"scales": torch.ones(5, 3)}, r"scales: got shape \(5, 3\), expected \(5, 2\)"),
        ({"sh": torch.zeros(5, 2, 3)}, "2 coefficients a channel, expected 1, 4, 9 or 16"),
        (
            {"means": torch.tensor([[0, 0, 0]] * 4 + [[0, float("nan"), 0]])},
            r"means: nan at index \(4, 1\)",
        ),
        (
            {"quats": torch.tensor([[1.0, 0, 0, 0]] * 3 + [[0, 0, 0, 0]] * 2)},
            "zero quaternion at index 3 .2 of 5",
        ),
        ({"scales": torch.tensor([[1.0, 1]] * 4 + [[1, 0]])}, "not positive at index 4"),
        (
            {"opacities": torch.tensor([0.0, 1.0, 1.1, 0, 0])},
            r"opacity outside \[0, 1\] at index 2",
        ),
        ({"means": torch.zeros(5, 3, dtype=torch.float16)}, "means: got torch.float16"),
        ({"origin": [0, 0, float("inf")]}, "origin: inf"),
    ],
)
def test_wrong_splats_are_refused_by_name_and_row(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(splats(), **changes)


@pytest.mark.door
def test_a_list_in_place_of_a_tensor_is_named():
    for name in ("means", "quats", "scales", "opacities", "sh"):
        values = getattr(splats(), name).tolist()
        with pytest.raises(
            TypeError, match=f"{name}: got list, expected a torch.Tensor or a NumPy"
        ):
            dataclasses.replace(splats(), **{name: values})
