"""The commands about scenes: what is wrong with an option is one line and exit code 2."""

import json

import pytest
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app

EXPORT = ["scenes", "export", "spheres", "--size", "16", "--spp", "1", "--points", "10"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["render", "opposed", "--views", ","], "views: got none, expected names of cameras"),
    ],
)
def test_a_value_that_makes_no_sense_is_told_in_a_line(tmp_path, arguments, says):
    done = CliRunner().invoke(
        app,
        ["scenes", *(a.format(out=tmp_path / "out") for a in arguments)],
        catch_exceptions=False,
    )
    assert done.exit_code == 2 and says in done.stderr


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("transforms.json", json.dumps({"frames": [{"file_path": "images/IMG_0001.jpg"}]})),
        (
            "transforms.json",
            json.dumps(
                {"frames": [{"file_path": "images/orbit_000_of_1.png"}, {"file_path": "b.png"}]}
            ),
        ),
        ("transforms.json", "{"),
        ("points.ply", "ply"),
    ],
)
def test_an_export_leaves_the_poses_and_points_of_a_capture_alone(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    done = CliRunner().invoke(app, [*EXPORT, str(tmp_path)])
    assert done.exit_code == 2 and "of a capture that this command did not write" in done.stderr
    assert (tmp_path / name).read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_scene_is_shown_before_how_its_pictures_are_made():
    done = CliRunner().invoke(app, ["scenes", "show", "spheres"])
    assert done.exit_code == 0, done.output
    contents, made = done.stdout.split("pictures are made by\n")
    assert contents.startswith("spheres: ") and "\nlights: sun, sky\n" in contents
    assert "light from sun, sky\n" in made and "because 3 bounces: paths of up to 4 edges" in made


def test_an_export_is_made_anew_in_its_own_folder(tmp_path):
    for views in ("2", "3"):
        done = CliRunner().invoke(app, [*EXPORT, str(tmp_path / "out"), "--views", views])
        assert done.exit_code == 0, done.output
        own = tmp_path / "out" / "images" / "mine.png"
        own.write_bytes(b"")
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert len(frames) == 3
    # No picture of the former export stays among these, and those of others do.
    there = {path.relative_to(tmp_path / "out").as_posix() for path in own.parent.iterdir()}
    assert there == {frame["file_path"] for frame in frames} | {"images/mine.png"}
