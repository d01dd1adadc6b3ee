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


@pytest.mark.parametrize("length", [1e-14, 1.0, 1e14])
def test_rotations_are_scipys_for_quaternions_of_any_length(length):
    model = splats(dtype=torch.float64)
    w, x, y, z = model.quats.T.numpy() * 7.0
    model = dataclasses.replace(model, quats=length * model.quats)
    expected = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    assert np.abs(model.rotations().numpy() - expected).max() < 1e-14


def test_the_normal_is_the_third_axis_of_a_disc_and_the_shortest_of_an_ellipsoid():
    disc = splats("2d", dtype=torch.float64)
    assert torch.equal(disc.normals(), disc.rotations()[:, :, 2])
    scales = torch.tensor([[0.1, 2, 3], [2, 0.1, 3], [3, 2, 0.1]], dtype=torch.float64)
    ball = splats("3d", n=3, dtype=torch.float64, scales=scales)
    expected = torch.stack([ball.rotations()[i, :, i] for i in range(3)])
    assert torch.equal(ball.normals(), expected)


def test_colours_become_the_constant_harmonic():
    sh = Gaussians.sh_from_rgb(torch.tensor([[0.5, 0.0, 1.0]]))
    # Y_00 = 1 / (2 sqrt(pi))
    assert sh.shape == (1, 1, 3)
    assert (sh[0, 0] / (2 * np.sqrt(np.pi)) + 0.5).tolist() == pytest.approx(
        [0.5, 0.0, 1.0], abs=1e-6
    )


def test_far_away_means_keep_their_digits_through_the_origin():
    origin = np.array([1e6, 2e6, -3e6])
    model = splats(origin=origin)
    assert np.array_equal(
        model.world_means() - origin, (model.means.numpy().astype(np.float64) + origin) - origin
    )
    assert np.abs(model.world_means() - origin - model.means.numpy()).max() < 1e-9


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


def test_an_array_in_place_of_a_tensor_is_named():
    for name in ("means", "quats", "scales", "opacities", "sh"):
        array = getattr(splats(), name).numpy()
        with pytest.raises(TypeError, match=f"{name}: got ndarray, expected torch.Tensor"):
            dataclasses.replace(splats(), **{name: array})
