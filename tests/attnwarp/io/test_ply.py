import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from further import further

from attnwarp import Camera, Gaussians
from attnwarp.errors import InputWarning
from attnwarp.io import THIRD_SCALE, FileFormatError, read_ply, read_points, write_ply, write_points
from attnwarp.render import render

DEGREE = {0: 0, 1: 9, 2: 24, 3: 45}


def names(scales=3, rest=0, normals=True):
    return [
        *"xyz",
        *(("nx", "ny", "nz") if normals else ()),
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)),
        "opacity",
        *(f"scale_{i}" for i in range(scales)),
        *(f"rot_{i}" for i in range(4)),
    ]


def by_hand(path, columns, n, *, form="binary_little_endian", comments=(), types=None, extra=b""):
    """A PLY assembled from its specification with struct: the oracle of the reader."""
    types = types or {}
    head = ["ply", f"format {form} 1.0", *(f"comment {c}" for c in comments), f"element vertex {n}"]
    head += [f"property {types.get(name, 'float')} {name}" for name in columns]
    body = b""
    for row in range(n):
        values = [columns[name][row] for name in columns]
        if form == "ascii":
            body += (" ".join(repr(float(v)) for v in values) + "\n").encode()
        else:
            order = "<" if form == "binary_little_endian" else ">"
            codes = "".join(
                {"float": "f", "double": "d", "uchar": "B"}[types.get(name, "float")]
                for name in columns
            )
            body += struct.pack(order + codes, *values)
    path.write_bytes(("\n".join([*head, "end_header"]) + "\n").encode() + body + extra)
    return path


def columns_of(n, rng, scales=3, rest=0):
    columns = {name: rng.normal(size=n).astype(np.float32) for name in names(scales, rest)}
    for name in ("nx", "ny", "nz"):
        columns[name][:] = 0
    return columns


def parse_by_hand(path):
    """Header lines and rows of a file of ours, without a PLY library."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    props = [line.split() for line in lines if line.startswith("property")]
    assert all(kind == "float" for _, kind, _ in props)
    (count,) = [int(line.split()[2]) for line in lines if line.startswith("element vertex")]
    values = np.array(struct.unpack(f"<{count * len(props)}f", body), dtype=np.float32).reshape(
        count, len(props)
    )
    return lines, {prop[2]: values[:, i] for i, prop in enumerate(props)}


def model(n=7, kind="3d", degree=3, seed=0, **more):
    rng = np.random.default_rng(seed)

    def tensor(*shape):
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    scales = torch.exp(tensor(n, 2 if kind == "2d" else 3) * 2 - 3)
    opacities = torch.sigmoid(tensor(n) * 4)
    return Gaussians(
        kind, tensor(n, 3), tensor(n, 4), scales, opacities, tensor(n, (degree + 1) ** 2, 3), **more
    )


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_file_made_by_hand_is_read_in_every_encoding(tmp_path, form, degree):
    n, rest = 5, DEGREE[degree]
    columns = columns_of(n, np.random.default_rng(degree), rest=rest)
    g = read_ply(by_hand(tmp_path / "a.ply", columns, n, form=form))
    assert g.kind == "3d" and not g.antialiased and g.sh_degree == degree and (g.origin == 0).all()
    for i, name in enumerate("xyz"):
        assert np.array_equal(g.means[:, i].numpy(), columns[name])
    for i in range(4):
        assert np.array_equal(g.quats[:, i].numpy(), columns[f"rot_{i}"])
    for row in range(n):
        # exp and the sigmoid of the float32 in the file, in double, rounded once: half an ulp of
        # float32.
        for i in range(3):
            assert g.scales[row, i].item() == pytest.approx(
                math.exp(float(columns[f"scale_{i}"][row])), rel=6e-8
            )
        logit = float(columns["opacity"][row])
        assert g.opacities[row].item() == pytest.approx(1 / (1 + math.exp(-logit)), rel=6e-8)
        for channel in range(3):
            assert g.sh[row, 0, channel].item() == columns[f"f_dc_{channel}"][row]
            # Channel-major: all coefficients of red, then of green, then of blue.
            for k in range(rest // 3):
                assert (
                    g.sh[row, 1 + k, channel].item()
                    == columns[f"f_rest_{channel * (rest // 3) + k}"][row]
                )


def test_further_properties_elements_and_missing_normals_do_not_matter(tmp_path):
    columns = columns_of(3, np.random.default_rng(0))
    for name in ("nx", "ny", "nz"):
        del columns[name]
    columns = {"segment": np.ones(3), **columns, "label": np.ones(3)}
    g = read_ply(by_hand(tmp_path / "a.ply", columns, 3))
    assert np.array_equal(g.means[:, 2].numpy(), columns["z"])


@pytest.mark.parametrize("kind", ["2d", "3d"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_written_file_has_the_trainers_properties_in_their_order(tmp_path, kind, degree):
    g = model(kind=kind, degree=degree)
    write_ply(tmp_path / "a.ply", g)
    lines, columns = parse_by_hand(tmp_path / "a.ply")
    assert list(columns) == names(2 if kind == "2d" else 3, DEGREE[degree])
    assert f"comment attnwarp kind {kind}" in lines
    assert (columns["nx"] == 0).all() and (columns["nz"] == 0).all()
    rest = DEGREE[degree] // 3
    for row in range(len(g)):
        for channel in range(3):
            for k in range(rest):
                assert (
                    columns[f"f_rest_{channel * rest + k}"][row] == g.sh[row, 1 + k, channel].item()
                )
        o = g.opacities[row].item()
        # The logarithm in double, rounded once to float32.
        assert columns["opacity"][row] == pytest.approx(math.log(o / (1 - o)), rel=1e-7, abs=1e-7)
        assert columns["scale_1"][row] == pytest.approx(
            math.log(g.scales[row, 1].item()), rel=1e-7, abs=1e-7
        )


@pytest.mark.parametrize("kind", ["2d", "3d"])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("third_scale", [None, THIRD_SCALE, 0.5])
def test_what_is_written_is_read_back(tmp_path, kind, antialiased, third_scale):
    if kind == "3d" and third_scale is not None:
        with pytest.raises(ValueError, match="third_scale"):
            write_ply(tmp_path / "a.ply", model(), third_scale=third_scale)
        return
    origin = np.array([448262.123456789012, -5411932.1, 1 / 3])
    g = model(300, kind, origin=origin, antialiased=antialiased)
    g.opacities[:2] = torch.tensor([0.0, 1.0])
    write_ply(tmp_path / "a.ply", g, third_scale=third_scale, coordinates="relative")
    back = read_ply(tmp_path / "a.ply")
    assert (back.kind, back.antialiased) == (kind, antialiased)
    for name in ("means", "quats", "sh"):
        assert torch.equal(getattr(back, name), getattr(g, name))
    assert np.array_equal(back.origin, origin)
    assert back.opacities[:2].tolist() == [0.0, 1.0]
    # A float32 logarithm up to 104 in size is off by at most 3.8e-6, and so is what it stands for,
    # relatively.
    torch.testing.assert_close(back.scales, g.scales, rtol=4e-6, atol=0)
    torch.testing.assert_close(back.opacities, g.opacities, rtol=4e-6, atol=0)


def test_every_float32_opacity_next_to_0_and_1_stays_apart_from_them(tmp_path):
    tiny = np.nextafter(np.float32(0), np.float32(1))
    nearly = np.nextafter(np.float32(1), np.float32(0))
    g = model(5)
    g.opacities = torch.tensor([0.0, float(tiny), 0.5, float(nearly), 1.0])
    write_ply(tmp_path / "a.ply", g)
    _, columns = parse_by_hand(tmp_path / "a.ply")
    assert np.isfinite(columns["opacity"]).all()
    back = read_ply(tmp_path / "a.ply").opacities
    assert back[[0, 2, 4]].tolist() == [0.0, 0.5, 1.0]
    assert back[1] > 0 and back[3] < 1
    # Viewers take the sigmoid in float32.
    with np.errstate(over="ignore"):
        sigmoid = np.float32(1) / (np.float32(1) + np.exp(-columns["opacity"]))
    assert sigmoid[[0, 4]].tolist() == [0.0, 1.0]


def test_infinite_logits_of_other_writers_are_opacity_0_and_1(tmp_path):
    columns = columns_of(2, np.random.default_rng(0))
    columns["opacity"][:] = [-np.inf, np.inf]
    assert read_ply(by_hand(tmp_path / "a.ply", columns, 2)).opacities.tolist() == [0.0, 1.0]


def test_a_comment_may_be_in_any_encoding(tmp_path):
    columns = columns_of(2, np.random.default_rng(0))
    path = by_hand(tmp_path / "a.ply", columns, 2, comments=["gr", "attnwarp kind 3d"])
    path.write_bytes(path.read_bytes().replace(b"comment gr", b"comment gr\xf6\xdfe"))
    assert np.array_equal(read_ply(path).means[:, 0].numpy(), columns["x"])


def test_an_empty_model_makes_the_trip(tmp_path):
    write_ply(tmp_path / "a.ply", model(0, "2d", degree=1))
    back = read_ply(tmp_path / "a.ply")
    assert len(back) == 0 and back.kind == "2d" and back.sh_degree == 1


# -------- other readers


def test_open3d_reads_points_and_colours_and_writes_what_is_read(tmp_path):
    import ctypes

    import libusb_package

    # A bare machine lacks the libusb that Open3D links.
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    colors = np.random.default_rng(0).integers(0, 256, (20, 3)).astype(np.uint8)
    points = np.random.default_rng(1).normal(size=(20, 3)) * 1e6
    write_points(tmp_path / "p.ply", points, colors)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "p.ply"))
    assert np.array_equal(np.asarray(cloud.points), points)
    assert np.array_equal(np.round(np.asarray(cloud.colors) * 255), colors)
    open3d.io.write_point_cloud(str(tmp_path / "q.ply"), cloud)
    back, back_colors = read_points(tmp_path / "q.ply")
    assert np.array_equal(back, points)
    assert np.array_equal(back_colors, colors)


# -------- which kind


def test_two_scales_are_2d_and_three_are_3d(tmp_path):
    rng = np.random.default_rng(0)
    assert read_ply(by_hand(tmp_path / "a.ply", columns_of(4, rng, scales=2), 4)).kind == "2d"
    assert read_ply(by_hand(tmp_path / "b.ply", columns_of(4, rng, scales=3), 4)).kind == "3d"


@pytest.mark.parametrize("comment", ["attnwarp kind 2d", "SplatRenderMode: 2dgs"])
def test_a_comment_makes_three_scales_2d_and_the_third_is_dropped_whatever_it_is(tmp_path, comment):
    columns = columns_of(4, np.random.default_rng(0))
    columns["scale_2"][:] = -np.inf
    g = read_ply(by_hand(tmp_path / "a.ply", columns, 4, comments=[comment]))
    assert g.kind == "2d" and g.scales.shape == (4, 2)


def test_the_usual_third_scale_is_recognised_after_a_tool_dropped_the_comments(tmp_path):
    columns = columns_of(4, np.random.default_rng(0))
    columns["scale_2"][:] = np.log(1e-6)
    assert read_ply(by_hand(tmp_path / "a.ply", columns, 4)).kind == "2d"
    columns["scale_2"][3] += 1
    assert read_ply(by_hand(tmp_path / "a.ply", columns, 4)).kind == "3d"


def test_another_constant_flat_third_scale_has_to_be_decided_by_the_caller(tmp_path):
    columns = columns_of(4, np.random.default_rng(0))
    columns["scale_2"][:] = -20
    path = by_hand(tmp_path / "a.ply", columns, 4)
    with pytest.raises(FileFormatError, match=r"scale_2.*pass kind='2d' or kind='3d'"):
        read_ply(path)
    assert read_ply(path, kind="2d").kind == "2d"
    assert read_ply(path, kind="3d").scales.shape == (4, 3)


def test_the_kind_can_be_forced_but_not_invented(tmp_path):
    columns = columns_of(4, np.random.default_rng(0), scales=2)
    path = by_hand(tmp_path / "a.ply", columns, 4)
    with pytest.raises(FileFormatError, match=r"scale_2: missing.*pass kind='2d'"):
        read_ply(path, kind="3d")
    with pytest.raises(ValueError, match="kind: got '2D', expected one of"):
        read_ply(path, kind="2D")
    path = by_hand(tmp_path / "b.ply", columns, 4, comments=["attnwarp kind 3d"])
    with pytest.raises(FileFormatError, match="scale_2: missing"):
        read_ply(path)


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        ((), False),
        (("SplatRenderMode: mip",), True),  # Brush, PlayCanvas splat-transform
        (("SplatRenderMode: default",), False),
        (("antialiased 1",), True),  # Postshot
        (("antialiased 0",), False),
        (("Exported from a tool that was antialiased 1 day ago",), False),
    ],
)
def test_the_antialias_comments_of_other_programs_are_understood(tmp_path, comments, expected):
    path = by_hand(
        tmp_path / "a.ply", columns_of(2, np.random.default_rng(0)), 2, comments=comments
    )
    assert read_ply(path).antialiased is expected


@pytest.mark.parametrize("given", [None, False])
def test_the_filter_of_mip_splatting_is_merged_into_scales_and_opacities(tmp_path, given):
    """Oracle: the covariance matrices of both, in float64."""
    rng = np.random.default_rng(5)
    columns = columns_of(4, rng)
    columns["filter_3D"] = rng.uniform(0.1, 2, 4).astype(np.float32)
    path = by_hand(tmp_path / "mip.ply", columns, 4)
    with pytest.warns(InputWarning, match="is of Mip-Splatting"):
        read = read_ply(path, antialiased=given)
    assert read.antialiased is (given is None)
    turn = rng.normal(size=(3, 3))
    turn = np.linalg.qr(turn)[0]  # any axes: the filter is a sphere
    for k in range(4):
        before = turn @ np.diag(np.exp([2.0 * columns[f"scale_{i}"][k] for i in range(3)])) @ turn.T
        after = before + columns["filter_3D"][k].astype(float) ** 2 * np.eye(3)
        wide = np.sqrt(np.linalg.eigvalsh(after))
        np.testing.assert_allclose(np.sort(read.scales[k].numpy()), wide, rtol=1e-5)
        share = np.sqrt(np.linalg.det(before) / np.linalg.det(after))
        opacity = share / (1 + math.exp(-columns["opacity"][k]))
        assert float(read.opacities[k]) == pytest.approx(opacity, rel=1e-5)


# -------- origin


def test_far_away_double_positions_are_kept_relative_to_a_rounded_origin(tmp_path):
    rng = np.random.default_rng(0)
    columns = columns_of(100, rng)
    world = np.array([448262.25, 5411932.5, 310.0]) + rng.uniform(-30, 30, (100, 3))
    for i, name in enumerate("xyz"):
        columns[name] = world[:, i]
    path = by_hand(tmp_path / "a.ply", columns, 100, types=dict.fromkeys("xyz", "double"))
    g = read_ply(path)
    assert g.means.dtype == torch.float32
    # Half an ulp of float32 below 64: 2e-6; float32 world coordinates would be off by 0.25.
    assert np.abs(g.world_means() - world).max() < 2e-6
    assert np.array_equal(g.origin, np.round(g.origin, -1)), "rounded to tens for a box of 60"
    with pytest.warns(InputWarning, match="attnwarp origin"):
        write_ply(tmp_path / "b.ply", g)
    assert np.array_equal(read_ply(tmp_path / "b.ply").world_means(), g.world_means())


def test_float64_means_far_away_lose_nothing_in_a_float32_file(tmp_path):
    g = model(50).to(dtype=torch.float64)
    g.means = g.means + torch.tensor([1e6, -2e6, 3e5], dtype=torch.float64)
    g.origin = np.array([0.5, 0.0, 0.0])
    with pytest.warns(InputWarning, match="attnwarp origin"):
        write_ply(tmp_path / "a.ply", g)
    back = read_ply(tmp_path / "a.ply")
    assert (
        np.abs(back.world_means() - g.world_means()).max() < 1e-6
    )  # 4 x 2^-24, and an ulp of 1e6 in float64


def test_double_positions_near_zero_and_exact_ones_need_no_origin(tmp_path):
    columns = columns_of(3, np.random.default_rng(0))
    types = dict.fromkeys("xyz", "double")
    for name in "xyz":
        columns[name] = np.array([0.1, 0.7, 1.3])
    assert (read_ply(by_hand(tmp_path / "a.ply", columns, 3, types=types)).origin == 0).all()
    for name in "xyz":
        columns[name] = np.array([4096.0, 4096.5, 4097.0])
    assert (read_ply(by_hand(tmp_path / "b.ply", columns, 3, types=types)).origin == 0).all()
    for name in "xyz":
        columns[name] = np.full(3, 123456.789)
    g = read_ply(by_hand(tmp_path / "c.ply", columns, 3, types=types))
    assert np.array_equal(g.world_means(), np.full((3, 3), 123456.789))


# -------- malformed files


def refused(path, *parts, reader=read_ply):
    with pytest.raises(FileFormatError) as caught:
        reader(path)
    for part in (str(path), *parts):
        assert part in str(caught.value), str(caught.value)
    return caught.value


@pytest.mark.parametrize("name", ["x", "opacity", "scale_1", "rot_3", "f_rest_4"])
def test_a_missing_property_is_named(tmp_path, name):
    columns = columns_of(3, np.random.default_rng(0), rest=9)
    columns["f_rest_9" if name == "f_rest_4" else "spare"] = columns.pop(name)
    error = refused(by_hand(tmp_path / "a.ply", columns, 3), name, "missing")
    assert error.field == name


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("y", np.nan, "x, y, z"),
        ("f_rest_7", np.nan, "sh"),
        ("opacity", np.nan, "opacities"),
        ("scale_1", 90.0, "scales"),  # e^90 does not fit float32, and e^-150 is 0 there
        ("scale_0", -150.0, "scales"),
        ("rot_1", np.inf, "quats"),
    ],
)
def test_a_value_out_of_range_is_named_with_its_first_row(tmp_path, name, value, part):
    columns = columns_of(6, np.random.default_rng(0), rest=9)
    columns.setdefault(name, np.ones(6, np.float32))[[3, 5]] = value
    refused(by_hand(tmp_path / "a.ply", columns, 6), f"{part}: ", "3")


@pytest.mark.parametrize("value", [0.0, 1e-30])
def test_a_quaternion_without_direction_is_refused(tmp_path, value):
    columns = columns_of(6, np.random.default_rng(0))
    for i in range(4):
        columns[f"rot_{i}"][2] = value
    refused(by_hand(tmp_path / "a.ply", columns, 6), "quats: zero quaternion at index 2")


def test_a_position_beyond_float32_is_refused(tmp_path):
    columns = columns_of(3, np.random.default_rng(0))
    columns["x"] = np.array([0.0, 1e300, 1.5])
    refused(by_hand(tmp_path / "a.ply", columns, 3, types={"x": "double"}), "means")


@pytest.mark.parametrize("count", [8, 10, 72])
def test_a_wrong_number_of_harmonics_is_refused(tmp_path, count):
    path = by_hand(tmp_path / "a.ply", columns_of(2, np.random.default_rng(0), rest=count), 2)
    refused(path, "f_rest_*", f"got {count}", "0, 9, 24 or 45")


def test_a_header_that_promises_too_much_does_not_eat_the_memory(tmp_path):
    whole = by_hand(tmp_path / "a.ply", columns_of(2, np.random.default_rng(0)), 2).read_bytes()
    (tmp_path / "b.ply").write_bytes(whole.replace(b"vertex 2", b"vertex 99999999999"))
    refused(tmp_path / "b.ply", "vertex", "row 2 of the 99999999999")


@pytest.mark.parametrize("reader", [read_ply, read_points])
@pytest.mark.parametrize(
    ("content", "part"),
    [
        (b"", "empty"),
        (b"hello, this is a text\n", "not a PLY"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty float x\nend_header\n1\n", "vertex"),
    ],
)
def test_what_is_not_a_ply_file_is_refused(tmp_path, reader, content, part):
    (tmp_path / "a.ply").write_bytes(content)
    refused(tmp_path / "a.ply", part, reader=reader)


def test_folders_and_absent_files_and_other_formats_say_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_ply(tmp_path / "none.ply")
    refused(tmp_path, "folder")
    write_points(tmp_path / "p.ply", np.zeros((2, 3)))
    refused(tmp_path / "p.ply", "point cloud", "read_points")
    for comment in ("attnwarp origin 1 two 3", "attnwarp origin 1 2", "attnwarp far -1"):
        columns = columns_of(1, np.random.default_rng(0))
        refused(by_hand(tmp_path / "o.ply", columns, 1, comments=[comment]), comment.split()[1])


def test_point_clouds_with_bad_colours_or_values_are_refused(tmp_path):
    xyz = {name: [0.0, 1.0] for name in "xyz"}
    path = by_hand(
        tmp_path / "a.ply", {**xyz, "red": [0.1, 0.2], "green": [0, 0], "blue": [0, 0]}, 2
    )
    refused(path, "red", "uchar", reader=read_points)
    path = by_hand(tmp_path / "b.ply", {**xyz, "red": [1, 2]}, 2, types={"red": "uchar"})
    refused(path, "green", "missing", reader=read_points)
    path = by_hand(tmp_path / "c.ply", {**xyz, "z": [0.0, np.nan]}, 2)
    refused(path, "x, y, z: not every point is finite", reader=read_points)


# -------- writing


def test_bad_values_are_refused_before_anything_is_written(tmp_path):
    write_ply(tmp_path / "a.ply", model())
    before = (tmp_path / "a.ply").read_bytes()
    for name, value in (
        ("means", float("nan")),
        ("quats", 0.0),
        ("opacities", 1.5),
        ("scales", -1.0),
    ):
        g = model()
        getattr(g, name)[2] = value
        with pytest.raises(ValueError, match=name):
            write_ply(tmp_path / "a.ply", g)
    wide = model().to(dtype=torch.float64)
    wide.sh[1] = 1e200
    with pytest.raises(ValueError, match="sh"):
        write_ply(tmp_path / "a.ply", wide)
    assert (tmp_path / "a.ply").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_tensors_that_are_being_trained_can_be_written(tmp_path):
    g = model()
    g.means = g.means.requires_grad_()
    write_ply(tmp_path / "a.ply", g)
    assert torch.equal(read_ply(tmp_path / "a.ply").means, g.means.detach())


# -------- world coordinates and damage


def test_means_are_written_in_world_coordinates_which_every_program_reads(tmp_path):
    g = model(50, "2d", origin=np.array([3.25, -7.5, 0.125]))
    write_ply(tmp_path / "a.ply", g)
    lines, columns = parse_by_hand(tmp_path / "a.ply")
    assert not [line for line in lines if "origin" in line]
    expected = (g.means.double().numpy() + g.origin).astype(np.float32)
    for i, name in enumerate("xyz"):
        assert np.array_equal(columns[name], expected[:, i])
    assert (read_ply(tmp_path / "a.ply").origin == 0).all()


def test_an_origin_is_written_only_where_float32_would_lose_more_than_is_asked(tmp_path):
    g = model(50, origin=np.array([4e5, 5e6, 0.0]))  # an ulp of 5e6 is 0.5
    with pytest.warns(InputWarning, match=r"other programs will show .* around zero.*50 of 50"):
        write_ply(tmp_path / "a.ply", g)
    back = read_ply(tmp_path / "a.ply")
    assert np.array_equal(back.origin, g.origin) and torch.equal(back.means, g.means)
    with pytest.warns(InputWarning, match=r"world coordinates move 50 of 50 splats"):
        write_ply(tmp_path / "b.ply", g, coordinates="world")
    back = read_ply(tmp_path / "b.ply")
    assert (back.origin == 0).all()
    assert np.abs(back.world_means() - g.world_means()).max() <= 0.25
    with pytest.raises(ValueError, match="coordinates: got 'local'"):
        write_ply(tmp_path / "d.ply", g, coordinates="local")


def test_files_with_the_origin_of_earlier_versions_are_read(tmp_path):
    columns = columns_of(3, np.random.default_rng(0))
    comments = ["attnwarp kind 3d", "attnwarp origin 100.5 -2.0 1e6"]
    g = read_ply(by_hand(tmp_path / "a.ply", columns, 3, comments=comments))
    assert g.origin.tolist() == [100.5, -2.0, 1e6]
    assert np.array_equal(g.means[:, 0].numpy(), columns["x"])


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", [1, 4, 68])
def test_inserted_bytes_are_refused_wherever_they_are(tmp_path, form, count):
    columns = columns_of(10, np.random.default_rng(0))
    whole = by_hand(tmp_path / "a.ply", columns, 10, form=form).read_bytes()
    head = whole.index(b"end_header\n") + len(b"end_header\n")
    patch = b"\n0 " * count if form == "ascii" else bytes(count)
    for start in range(head, len(whole) + 1, 97):
        (tmp_path / "b.ply").write_bytes(whole[:start] + patch + whole[start:])
        refused(tmp_path / "b.ply")


@pytest.mark.parametrize(("sigma", "peak"), [(0.5, 0.3027), (1.0, 0.6301), (3.0, 0.8611)])
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_splat_of_mip_splatting_peaks_as_its_own_renderer_draws_it(
    sigma, peak, backend, tmp_path
):
    """Closed form: 0.9 (s^2 / v)^1.5 v / (v + 0.1) with v = s^2 + 0.45^2, in px."""
    columns = {name: np.zeros(1, np.float32) for name in names()}
    depth, focal = 4.0, 100.0
    columns["z"][:] = depth
    columns["opacity"][:] = math.log(0.9 / 0.1)
    columns["rot_0"][:] = 1
    for i in range(3):
        columns[f"scale_{i}"][:] = math.log(sigma * depth / focal)
    columns["filter_3D"] = np.full(1, 0.45 * depth / focal, np.float32)
    path = by_hand(tmp_path / "mip.ply", columns, 1)
    with pytest.warns(InputWarning, match="screen filter of 0.1 px"):
        read = read_ply(path)
    K = np.array([[focal, 0, 16.5], [0, focal, 16.5], [0, 0, 1]])
    camera = Camera(K, np.eye(4), 33, 33)
    drawn = float(render(read, camera, backend=backend).alpha[16, 16])
    v = sigma**2 + 0.45**2
    assert drawn == pytest.approx(0.9 * (sigma**2 / v) ** 1.5 * v / (v + 0.1), abs=2e-5)
    assert drawn == pytest.approx(peak, abs=6e-5)


def test_a_screen_filter_is_kept_by_a_file_and_overruled_by_the_caller(tmp_path):
    wide = replace(model(), screen_filter=0.1)
    write_ply(tmp_path / "a.ply", wide)
    write_ply(tmp_path / "b.ply", model())
    assert b"screen_filter" not in (tmp_path / "b.ply").read_bytes()
    assert read_ply(tmp_path / "a.ply").screen_filter == 0.1
    assert read_ply(tmp_path / "a.ply", screen_filter=0.2).screen_filter == 0.2
    assert read_ply(tmp_path / "b.ply").screen_filter == 0.3
    assert wide.digest() != model().digest()
    for wrong in ("0", "wide", "nan"):
        data = (
            (tmp_path / "a.ply")
            .read_bytes()
            .replace(b"screen_filter 0.1", f"screen_filter {wrong}".encode())
        )
        (tmp_path / "c.ply").write_bytes(data)
        with pytest.raises(FileFormatError, match=f"attnwarp screen_filter {wrong}': "):
            read_ply(tmp_path / "c.ply")
    with pytest.raises(ValueError, match="screen_filter: got 0, expected a number"):
        replace(model(), screen_filter=0)


def test_a_sky_is_kept_by_a_file(tmp_path):
    write_ply(tmp_path / "a.ply", replace(model(), far=1234.5))
    assert read_ply(tmp_path / "a.ply").far == 1234.5
    text = (tmp_path / "a.ply").read_bytes().replace(b"far 1234.5", b"far -1")
    (tmp_path / "bad.ply").write_bytes(text)
    with pytest.raises(FileFormatError, match="far: got .*-1.0, expected a positive distance"):
        read_ply(tmp_path / "bad.ply")


@pytest.mark.parametrize("width", further(0.1, 1e-4, 2.0))
@pytest.mark.parametrize("antialiased", [False, True])
def test_any_screen_filter_is_drawn_and_differentiated_as_the_reference_does(width, antialiased):
    """Oracle: torch's own derivatives of the reference in float64."""
    rng = np.random.default_rng(3)
    n = 6
    means = torch.tensor(rng.uniform(-0.4, 0.4, (n, 3)) + np.array([0, 0, 3]))
    scales = torch.tensor(rng.uniform(0.05, 0.2, (n, 3)))
    fields = {
        "quats": torch.tensor(rng.normal(size=(n, 4))),
        "opacities": torch.tensor(rng.uniform(0.3, 0.9, n)),
        "sh": torch.tensor(rng.uniform(-0.5, 0.5, (n, 1, 3))),
    }
    K = np.array([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    camera, found = Camera(K, np.eye(4), 32, 32), {}
    for backend in ("reference", "cpu"):
        leaves = [means.clone().requires_grad_(), scales.clone().requires_grad_()]
        made = Gaussians("3d", means=leaves[0], scales=leaves[1], **fields,
                         antialiased=antialiased, screen_filter=width)  # fmt: skip
        view = render(made, camera, backend=backend)
        (view.color.double() ** 2).sum().backward()
        found[backend] = [view.color.detach().double(), *(leaf.grad for leaf in leaves)]
    for one, other in zip(found["reference"], found["cpu"], strict=True):
        scale = float(one.abs().max())
        assert float((one - other).abs().max()) < 2e-4 * max(1.0, scale)
