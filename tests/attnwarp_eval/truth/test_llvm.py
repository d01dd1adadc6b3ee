"""Choice of Mitsuba's variant, and whether the pictures of the two are the same."""

import subprocess

import numpy as np
import pytest
from effect_scenes import FLOOR, SCENES, SKY, SUN, make
from further import further
from matplotlib.tri import LinearTriInterpolator, Triangulation
from typer.testing import CliRunner

from attnwarp.camera import Camera
from attnwarp_eval.cli.main import app
from attnwarp_eval.effects import proof
from attnwarp_eval.scene.base import linear_rgb
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.shapes import Mesh
from attnwarp_eval.truth import Geometry, appearance, llvm, mitsuba, pictures
from attnwarp_eval.truth.mitsuba import build
from attnwarp_eval.truth.plan import plan

pytestmark = pytest.mark.usefixtures("coarse_textures")


def forget_the_variant(patch):
    for name in ("ATTNWARP_MITSUBA", "DRJIT_LIBLLVM_PATH"):
        patch.setenv(name, "")  # so that whatever the test leaves there is undone
        patch.delenv(name)
    llvm.variant.cache_clear()


@pytest.fixture
def fresh_probe(monkeypatch):
    """Nothing named, nothing asked yet; afterwards as before."""
    forget_the_variant(monkeypatch)
    yield monkeypatch
    llvm.variant.cache_clear()


def children(patch, answer):
    """Stand-ins for the child process: ``answer(library)`` gives its exit code and what it
    prints."""
    asked = []

    def run(command, *, env, **_):
        asked.append(env.get("DRJIT_LIBLLVM_PATH"))
        code, said = answer(asked[-1])
        return subprocess.CompletedProcess(command, code, said, "")

    patch.setattr(llvm.subprocess, "run", run)
    return asked


@pytest.mark.parametrize(
    ("code", "said", "expected"),
    [
        (0, "works\n", "llvm_ad_rgb"),
        (-6, "", "scalar_rgb"),  # what LLVM 15 does: SIGABRT
        (-6, "works\n", "scalar_rgb"),  # died on its way out
        (1, "", "scalar_rgb"),
        (0, "wrong picture: 0.0\n", "scalar_rgb"),
    ],
)
def test_llvm_is_used_only_where_a_child_process_lived_through_it(
    fresh_probe, code, said, expected
):
    fresh_probe.setattr(llvm, "libraries", lambda: ["/a/libLLVM.so.19.1"])
    asked = children(fresh_probe, lambda _: (code, said))
    assert llvm.variant() == expected and llvm.variant() == expected
    assert asked == ["/a/libLLVM.so.19.1"]  # once in the life of a process


def test_a_probe_that_hangs_means_scalar_and_a_named_variant_needs_no_probe(fresh_probe):
    def hang(*args, **kwargs):
        raise subprocess.TimeoutExpired("python", 1)

    fresh_probe.setattr(llvm.subprocess, "run", hang)
    assert llvm.variant() == "scalar_rgb"
    llvm.variant.cache_clear()
    fresh_probe.setenv("ATTNWARP_MITSUBA", "scalar_rgb")
    fresh_probe.setattr(
        llvm.subprocess, "run", lambda *a, **k: pytest.fail("asked although a variant was named")
    )
    assert llvm.variant() == "scalar_rgb"


def test_a_named_variant_that_mitsuba_lacks_is_one_line(fresh_probe, tmp_path):
    fresh_probe.setenv("ATTNWARP_MITSUBA", "lvm_ad_rgb")
    asked = ["scenes", "render", "spheres", "--size", "16", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, asked)
    words = "ATTNWARP_MITSUBA: got 'lvm_ad_rgb', expected one of scalar_rgb, "
    assert result.exit_code == 2 and words in " ".join(result.stderr.split())


def test_the_first_library_that_works_is_taken_and_left_for_child_processes(fresh_probe):
    import os

    fresh_probe.setattr(llvm, "libraries", lambda: ["/a/20", "/a/19", "/a/18"])
    asked = children(fresh_probe, lambda library: (0, "works") if library == "/a/19" else (-6, ""))
    assert llvm.variant() == "llvm_ad_rgb" and asked == ["/a/20", "/a/19"]
    assert os.environ["DRJIT_LIBLLVM_PATH"] == "/a/19"


def test_a_library_that_a_person_names_is_the_only_one_tried(fresh_probe):
    fresh_probe.setattr(llvm, "libraries", lambda: ["/a/19"])
    fresh_probe.setenv("DRJIT_LIBLLVM_PATH", "/mine/libLLVM.so")
    asked = children(fresh_probe, lambda library: (-6, ""))
    assert llvm.variant() == "scalar_rgb" and asked == ["/mine/libLLVM.so"]


def test_without_a_library_in_the_usual_places_dr_jit_looks_itself(fresh_probe):
    fresh_probe.setattr(llvm, "libraries", list)
    asked = children(fresh_probe, lambda library: (1, ""))
    assert llvm.variant() == "scalar_rgb" and asked == [None]


def test_old_libraries_are_never_tried_and_the_newest_comes_first(fresh_probe, tmp_path):
    for name in (
        "libLLVM-14.so.1",
        "libLLVM-15.0.6.so.1",
        "libLLVM.so.19.1",
        "libLLVM-17.so",
        "libLLVM-20.txt",
    ):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    (tmp_path / "libLLVM-18.so").symlink_to("gone.so")
    fresh_probe.setattr(llvm, "PLACES", (str(tmp_path / "libLLVM*"),))
    assert llvm.libraries() == [str(tmp_path / "libLLVM.so.19.1"), str(tmp_path / "libLLVM-17.so")]


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", (19, 1)),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("/usr/lib/llvm-18/lib/libLLVM.so", (18,)),
        ("/opt/homebrew/opt/llvm@17/lib/libLLVM.dylib", (17,)),
        ("/opt/homebrew/opt/llvm/lib/libLLVM.dylib", None),
        ("/usr/lib/libLLVMSupport.so.19", None),
        ("/usr/lib/libLLVM-19.a", None),
    ],
)
def test_a_librarys_version_is_read_from_its_name(path, expected):
    assert llvm.version(path) == expected


# The real thing. Where no LLVM works these hold scalar_rgb to being chosen instead.
# --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def both():
    """The variants that render here."""
    with pytest.MonkeyPatch.context() as patch:
        forget_the_variant(patch)
        chosen = llvm.variant()
        renders = any(llvm.works(library) for library in llvm.libraries()[: llvm.TRIES] or [None])
        assert chosen == ("llvm_ad_rgb" if renders else "scalar_rgb")
        yield ["scalar_rgb", "llvm_ad_rgb"] if renders else ["scalar_rgb", "scalar_rgb"]
    llvm.variant.cache_clear()


@pytest.mark.parametrize(
    "name",
    [
        *further("spheres", "refraction", "medium", "subsurface", "depth_of_field"),
        pytest.param("caustics", marks=pytest.mark.slow),
    ],
)
def test_both_variants_make_the_same_picture_within_noise(both, name):
    scene = (load_scene("spheres") if name == "spheres" else SCENES[name]()).with_size(16, 16)
    made = plan(scene, 32)
    a, b = (
        np.stack(
            [
                mitsuba.render_plan(scene, scene.source, made, first + k, made_by=variant)
                for k in range(12)
            ]
        )
        for variant, first in zip(both, (0, 500), strict=True)
    )
    assert not any(level.differs for level in proof.levels(a, b, alpha=1e-3))
    same = proof.equivalence(a, b, margin=0.02)
    assert same.equal, same


def test_a_seed_gives_the_same_bits_in_either_variant(both):
    scene = load_scene("spheres").with_size(32, 32)
    for variant in both:
        first, again, other = (
            mitsuba.render_plan(scene, scene.source, plan(scene, 4), k, made_by=variant)
            for k in (3, 3, 4)
        )
        assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_pictures_of_the_two_variants_are_kept_apart(monkeypatch, tmp_path):
    monkeypatch.setenv("ATTNWARP_CACHE", str(tmp_path))
    scene = make([FLOOR], [SUN, SKY]).with_size(8, 8)
    made = []

    def render(scene, camera, plan, seed):
        made.append(pictures.variant())
        return np.full((8, 8, 3), len(made), np.float32)

    monkeypatch.setattr(pictures, "render_plan", render)
    for variant in ("scalar_rgb", "llvm_ad_rgb", "scalar_rgb", "llvm_ad_rgb"):
        monkeypatch.setattr(pictures, "variant", lambda variant=variant: variant)
        value = appearance(scene, scene.source)[0, 0, 0]
        assert value == 1 + (variant == "llvm_ad_rgb")
    assert made == ["scalar_rgb", "llvm_ad_rgb"]


# What float32 cannot compute
# --------------------------------------------------------------------------------------------------


def test_a_pixel_that_comes_out_undefined_is_rendered_again(monkeypatch):
    scene = make([FLOOR], [SUN, SKY]).with_size(8, 8)
    made = plan(scene, 4)
    whole = mitsuba.render_plan(scene, scene.source, made, 0)
    real, seeds = mitsuba.render._render_passes, []

    def broken(scene, camera, made, seed):
        seeds.append(seed)
        picture = real(scene, camera, made, seed)
        if len(seeds) == 1:
            picture[2, 3] = np.nan, 1.0, np.inf
        return picture

    monkeypatch.setattr(mitsuba.render, "_render_passes", broken)
    mended = mitsuba.render_plan(scene, scene.source, made, 0)
    assert np.isfinite(mended).all() and len(seeds) == 2 and seeds[0] != seeds[1]
    changed = (mended != whole).any(-1)
    assert not np.delete(changed.ravel(), 2 * 8 + 3).any()


def needles(width=3e-6):
    """A square of 40 quads, of which every second is ``width`` wide, with colours that differ from
    vertex to vertex.
    """
    x = np.cumsum([0.0] + [0.05, width] * 20)
    top, bottom = (np.stack([x, np.full_like(x, y), np.zeros_like(x)], axis=-1) for y in (0.0, 1.0))
    k, n = np.arange(len(x) - 1), len(x)
    faces = np.concatenate(
        [np.stack([k, k + 1, n + k], -1), np.stack([k + 1, n + k + 1, n + k], -1)]
    )
    return np.concatenate([top, bottom]), faces


def test_needles_are_closed_and_everything_else_stays():
    vertices, faces = needles()
    kept = build.without_needles(vertices, faces)
    assert len(kept) == 40  # two triangles of each of the 20 wide quads
    area = 0.5 * np.linalg.norm(np.cross(vertices[kept[:, 1]] - vertices[kept[:, 0]],
                                         vertices[kept[:, 2]] - vertices[kept[:, 0]]), axis=-1)  # fmt: skip
    assert area.sum() == pytest.approx(1.0, abs=1e-4) and area.min() > 0.02
    # No gap opens: every inner edge still has two triangles.
    edges = np.sort(np.concatenate([kept[:, [0, 1]], kept[:, [1, 2]], kept[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 1).sum() == 2 * 20 + 2 and (count == 2).sum() == len(count) - 42
    wide = np.array([[0, 1, 2]])
    assert build.without_needles(np.eye(3), wide) is wide


def test_colours_of_a_mesh_with_needles_are_those_of_its_texture(monkeypatch):
    # Mitsuba's own barycentric coordinates in these needles are NaN or anything.
    vertices, faces = needles()
    scene = make(
        [FLOOR], [SKY | {"horizon": "#ffffff", "zenith": "#ffffff", "radiance": 1.0}]
    ).with_size(64, 64)
    x, y, _ = vertices.T
    tint = np.stack([0.5 + 0.3 * np.sin(9 * x), 0.5 + 0.3 * np.cos(4 * y), 0.2 + 0.6 * x * y], -1)
    lifted = vertices - [0.5, 0.5, 0.0]
    monkeypatch.setattr(scene, "shapes", lambda: [Mesh(lifted, faces, None, tint)])
    camera = Camera.look_at((0, 0, 1), (0, 1e-9, 0), width=64, height=64, fov_y=40)
    mitsuba.forget()
    try:
        picture = mitsuba.render_plan(scene, camera, plan(scene, 64), 0)
    finally:
        mitsuba.forget()
    # Under an even white sky a flat surface shows its albedo: here the texture's colour times the
    # tint, which matplotlib interpolates over the same triangles.
    place = Geometry(scene).trace(camera).point + 0.5
    triangles = Triangulation(x, y, faces)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = [
            LinearTriInterpolator(triangles, c)(place[..., 0], place[..., 1]) for c in tint.T
        ]
    expected = np.ma.stack(between, axis=-1).filled(np.nan) * linear_rgb("#c0b090")
    inside = np.isfinite(expected).all(-1)
    assert inside.mean() > 0.9  # the needles are a few millionths of the square
    assert np.abs(picture - expected)[inside].max() < 0.01


@pytest.mark.parametrize(
    ("name", "expected"),
    # Two rectangles in one plane, of which either may be seen; spheres that only touch the ground.
    [("coplanar", "scalar_rgb"), ("spheres", "llvm_ad_rgb")],
)
def test_renderings_are_compared_in_scalar_where_surfaces_coincide(fresh_probe, name, expected):
    fresh_probe.setattr(llvm, "libraries", lambda: ["/a/libLLVM.so.19.1"])
    children(fresh_probe, lambda _: (0, "works\n"))
    assert mitsuba.comparable(load_scene(name)) == expected
