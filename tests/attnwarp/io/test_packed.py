"""Splats of phones and viewers, held to the PLY of the same scene within what each format keeps.

Oracle of the axes of SPZ and of the flags: github.com/nianticlabs/spz, whose files have y up and z
backward (RUB) where PLY files have y down and z forward, and flag 1 in byte 14; npm's
splat-transform 2.7.1 gives the same values to the bit.
"""

import gzip
import io
import json
import sys
import zipfile

import numpy as np
import pytest
import torch

from attnwarp import Gaussians
from attnwarp.errors import InputError, MissingExtraError
from attnwarp.io import FileFormatError, read_ply, write_ply
from attnwarp.io.ply_elements import parse_ply

gaussforge = pytest.importorskip("gaussforge")


def scene(degree=3, n=200):
    rng = np.random.default_rng(0)

    def tensor(*shape):
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    quats = torch.nn.functional.normalize(tensor(n, 4))
    scales, opacities = torch.exp(0.7 * tensor(n, 3) - 3), torch.sigmoid(tensor(n))
    return Gaussians(
        "3d", tensor(n, 3), quats, scales, opacities, 0.3 * tensor(n, (degree + 1) ** 2, 3)
    )


def packed(tmp_path, suffix, splats):
    write_ply(tmp_path / "plain.ply", splats)
    plain = (tmp_path / "plain.ply").read_bytes()
    name = suffix if suffix != "ply" else "compressed.ply"
    data = bytes(gaussforge.GaussForge().convert(plain, "ply", name)["data"])
    if suffix == "ply":
        # Their writer orders harmonics otherwise than the format: PlayCanvas writes a byte for each
        # f_rest in the order of PLY files, 256 (f / 8 + 0.5).
        columns = parse_ply(plain)[0]["vertex"].columns
        rest = np.stack([columns[f"f_rest_{i}"] for i in range(45)], axis=1)
        harmonics = np.clip(256 * (rest / 8 + 0.5), 0, 255).astype(np.uint8).tobytes()
        data = data[: -len(harmonics)] + harmonics
    path = tmp_path / f"packed.{suffix}"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("suffix", "degree", "position", "scale", "opacity", "harmonic"),
    [
        # SPZ: 12 bits behind the point, logarithms in steps of 1/16, opacity in bytes, harmonics of
        # degree 1 in steps of 1/16 and others of 1/8.
        ("spz", 3, 2**-12, 1 / 32, 1 / 255, 1 / 8),
        # SOG: 16 bits of a logarithm of the position, codebooks of 256 values for the rest.
        ("sog", 3, 1e-3, 0.02, 1 / 255, 0.05),
        # KSPLAT without compression: floats, colours and opacity in bytes.
        ("ksplat", 1, 1e-6, 1e-6, 1 / 255, 1e-6),
        # Compressed PLY: 11 and 10 bits of the chunk's box, harmonics in steps of 1/32.
        ("ply", 3, 8 / 2**10, 8 / 2**10, 1 / 255, 1 / 32),
    ],
)
def test_a_scene_is_that_of_its_ply(
    tmp_path, capfd, suffix, degree, position, scale, opacity, harmonic
):
    splats = scene(degree)
    read = read_ply(packed(tmp_path, suffix, splats))
    assert capfd.readouterr().out == ""
    assert read.kind == "3d" and len(read) == len(splats) and read.sh_degree == degree
    wanted = splats.means
    signs = torch.ones(16)
    if suffix == "spz":
        # gaussforge packs without turning, so that the file's scene is turned by half a turn.
        wanted = wanted * torch.tensor([1.0, -1.0, -1.0])
        signs[1:] = torch.tensor([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])
    order = torch.cdist(wanted.double(), read.means.double()).argmin(dim=1)
    assert len(set(order.tolist())) == len(splats)
    read = read.select(order)
    assert (read.means - wanted).abs().max() < position
    assert (read.scales.log() - splats.scales.log()).abs().max() <= scale + 1e-6
    assert (read.opacities - splats.opacities).abs().max() < opacity
    sh = splats.sh * signs[: splats.sh.shape[1], None]
    assert (read.sh[:, 1:] - sh[:, 1:]).abs().quantile(0.99) < harmonic
    assert (read.sh[:, 0] - sh[:, 0]).abs().max() < 0.02
    # Covariances tell rotations, whatever the quaternions' signs.
    R = read.rotations() * read.scales[:, None]
    covariance = R @ R.mT
    L = splats.rotations() * splats.scales[:, None]
    if suffix == "spz":
        L = torch.diag(torch.tensor([1.0, -1.0, -1.0])) @ L
    expected = L @ L.mT
    size = expected.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    assert ((covariance - expected).abs() / size).max() < 0.08


def test_an_antialiased_scene_stays_one(tmp_path):
    path = packed(tmp_path, "spz", scene())
    head = bytearray(gzip.decompress(path.read_bytes()))
    assert not read_ply(path).antialiased
    head[14] |= 1
    path.write_bytes(gzip.compress(bytes(head)))
    assert read_ply(path).antialiased and not read_ply(path, antialiased=False).antialiased
    path = packed(tmp_path, "sog", scene())
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | {"antialias": True}).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    path.write_bytes(stream.getvalue())
    assert read_ply(path).antialiased


@pytest.mark.parametrize("suffix", ["spz", "sog", "ksplat", "ply"])
def test_half_a_file_is_refused_in_one_line_that_names_it(tmp_path, suffix):
    path = packed(tmp_path, suffix, scene(3 if suffix == "ply" else 1))
    whole = path.read_bytes()
    for share in (0.3, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=f"packed.{suffix}: cannot be read") as refusal:
            read_ply(path)
        assert "\n" not in str(refusal.value)


def test_what_a_format_cannot_hold_and_a_missing_package_are_named(tmp_path, monkeypatch):
    path = packed(tmp_path, "ksplat", scene(2))
    with pytest.raises(FileFormatError, match="harmonics beyond degree 1"):
        read_ply(path)
    path = packed(tmp_path, "spz", scene())
    with pytest.raises(FileFormatError, match="holds 3DGS alone"):
        read_ply(path, kind="2d")
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    with pytest.raises(MissingExtraError, match=r"gaussforge.*formats"):
        read_ply(path)
