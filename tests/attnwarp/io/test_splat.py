import struct

import numpy as np
import pytest
import torch

from attnwarp import Gaussians
from attnwarp.io import THIRD_SCALE, FileFormatError, read_splat, write_splat


def model(n=40, kind="3d", **more):
    rng = np.random.default_rng(3)
    count = 2 if kind == "2d" else 3
    return Gaussians(
        kind,
        torch.from_numpy(rng.normal(size=(n, 3)).astype(np.float32)),
        torch.from_numpy(rng.normal(size=(n, 4)).astype(np.float32)),
        torch.from_numpy(np.exp(rng.normal(size=(n, count))).astype(np.float32)),
        torch.from_numpy(rng.uniform(size=n).astype(np.float32)),
        torch.from_numpy(rng.normal(size=(n, 4, 3)).astype(np.float32)),
        **more,
    )


def records(path):
    """Each 32 bytes by the published layout: 3 f32 position, 3 f32 scale, 4 u8 rgba, 4 u8
    quaternion.
    """
    data = path.read_bytes()
    assert len(data) % 32 == 0
    return [struct.unpack_from("<3f3f4B4B", data, at) for at in range(0, len(data), 32)]


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_records_decode_to_the_splats_sorted_by_size_times_opacity(tmp_path, kind):
    g = model(kind=kind)
    write_splat(tmp_path / "a.splat", g)
    rows = records(tmp_path / "a.splat")
    importance = [
        float(np.prod(g.scales[i].double().numpy())) * g.opacities[i].item() for i in range(len(g))
    ]
    order = sorted(range(len(g)), key=lambda i: -importance[i])
    assert len(rows) == len(g)
    for i, row in zip(order, rows, strict=True):
        assert row[:3] == tuple(g.means[i].tolist())
        scales = g.scales[i].tolist() + ([float(np.float32(THIRD_SCALE))] if kind == "2d" else [])
        assert list(row[3:6]) == scales
        color = np.clip(0.5 + 0.28209479177387814 * g.sh[i, 0].double().numpy(), 0, 1)
        # A byte holds 1/255 steps, rounded.
        assert np.abs(np.array(row[6:9]) / 255 - color).max() <= 0.5 / 255 + 1e-9
        assert abs(row[9] / 255 - g.opacities[i].item()) <= 0.5 / 255 + 1e-9
        quat = g.quats[i].double().numpy()
        quat /= np.linalg.norm(quat)
        # Steps of 1/128, rounded; +1 itself would need 256 and is clipped to 255.
        assert np.abs((np.array(row[10:14]) - 128) / 128 - quat).max() <= 1 / 128


def test_extreme_opacities_colours_and_quaternions_stay_in_a_byte(tmp_path):
    g = model(2)
    g.opacities = torch.tensor([0.0, 1.0])
    g.sh[0, 0], g.sh[1, 0] = 100.0, -100.0
    g.quats = torch.tensor([[1.0, 0, 0, 0], [-1.0, 0, 0, 0]])
    write_splat(tmp_path / "a.splat", g)
    last, first = records(tmp_path / "a.splat")[::-1]
    assert last[6:] == (255, 255, 255, 0, 255, 128, 128, 128)
    assert first[6:] == (0, 0, 0, 255, 0, 128, 128, 128)


def test_a_far_origin_is_refused_unless_the_caller_leaves_it_out(tmp_path):
    g = model(origin=np.array([1e8, 0, 0]))
    with pytest.raises(ValueError, match="coordinates='relative'"):
        write_splat(tmp_path / "a.splat", g)
    write_splat(tmp_path / "a.splat", g, coordinates="relative")
    assert {row[:3] for row in records(tmp_path / "a.splat")} == {
        tuple(p) for p in g.means.tolist()
    }
    g.origin = np.array([2.0, 0.0, 0.0])
    write_splat(tmp_path / "a.splat", g)
    world = {tuple(p) for p in g.world_means().astype(np.float32).tolist()}
    assert {row[:3] for row in records(tmp_path / "a.splat")} == world


@pytest.mark.door
def test_bad_values_are_refused(tmp_path):
    g = model()
    g.quats[7] = 0
    with pytest.raises(ValueError, match="quats: zero quaternion at index 7"):
        write_splat(tmp_path / "a.splat", g)
    with pytest.raises(ValueError, match="third_scale"):
        write_splat(tmp_path / "a.splat", model(), third_scale=0.0)
    with pytest.raises(ValueError, match="third_scale: got 1e-50"):  # 0 in the file's float32
        write_splat(tmp_path / "a.splat", model(), third_scale=1e-50)
    assert not list(tmp_path.iterdir())


def test_an_empty_model_is_an_empty_file(tmp_path):
    write_splat(tmp_path / "a.splat", model(0))
    assert (tmp_path / "a.splat").read_bytes() == b""


def test_a_file_made_by_hand_is_read(tmp_path):
    rows = [
        struct.pack("<6f8B", 1, -2, 3.5, 0.5, 0.25, 4, 255, 0, 51, 102, 192, 64, 128, 128),
        struct.pack("<6f8B", 0, 0, 1e6, 1, 1, 1e-3, 0, 0, 0, 255, 255, 128, 128, 128),
    ]
    (tmp_path / "a.splat").write_bytes(b"".join(rows))
    g = read_splat(tmp_path / "a.splat")
    assert (g.kind, len(g), g.sh_degree) == ("3d", 2, 0)
    assert g.means.tolist() == [[1, -2, 3.5], [0, 0, 1e6]]
    assert g.scales[0].tolist() == [0.5, 0.25, 4]
    assert g.quats[0].tolist() == [0.5, -0.5, 0, 0]
    np.testing.assert_allclose(g.opacities, [0.4, 1], atol=1e-7)
    color = 0.5 + 0.28209479177387814 * g.sh[0, 0].numpy()
    np.testing.assert_allclose(color, [1, 0, 0.2], atol=1e-6)


def test_what_is_written_is_read_back_to_a_byte(tmp_path):
    g = model()
    write_splat(tmp_path / "a.splat", g)
    write_splat(tmp_path / "b.splat", read_splat(tmp_path / "a.splat"))
    again = np.frombuffer((tmp_path / "b.splat").read_bytes(), np.uint8).reshape(-1, 32)
    once = np.frombuffer((tmp_path / "a.splat").read_bytes(), np.uint8).reshape(-1, 32)
    # Opacities are bytes now: rows of nearly equal importance may change places.
    np.testing.assert_array_equal(
        again[np.lexsort(again[:, :12].T)][:, :28], once[np.lexsort(once[:, :12].T)][:, :28]
    )


@pytest.mark.door
@pytest.mark.parametrize(
    ("change", "part"),
    [
        (lambda data: data[:-1], "multiple of 32"),
        (lambda data: data + b"\0", "multiple of 32"),
        (lambda data: data[:32] + struct.pack("<f", np.nan) + data[36:], "position: .* in row 1"),
        (lambda data: data[:44] + struct.pack("<f", 0) + data[48:], "scale: .* in row 1"),
        (lambda data: data[:60] + bytes([128] * 4) + data[64:], "quaternion: .* in row 1"),
        (lambda data: b"", "empty"),
    ],
)
def test_a_damaged_file_is_refused_by_row(tmp_path, change, part):
    write_splat(tmp_path / "a.splat", model(3))
    path = tmp_path / "a.splat"
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(FileFormatError, match=part):
        read_splat(path)
