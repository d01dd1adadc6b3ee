"""YAML from people: what cannot be meant is refused in one line, with its place, at once."""

import math

import pytest
import yaml

from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import SceneError
from attnwarp_eval.scene.yaml import (
    YamlError,
    _bare_color,
    line_of,
    read_yaml,
)

SCENE = """\
name: small
title: A ball on a floor
objects:
  - name: floor
    shape: {type: rectangle, center: [0, 0, 0], size: [8, 8]}
    texture: {type: checker, colors: ['#ffffff', '#404040'], size: 0.5}
  - name: ball
    shape: {type: sphere, center: [0, 0, 0.5], radius: 0.5}
    texture: {type: noise, colors: ['#1f2a52', '#5c7fc4'], size: 0.3}
  - name: post
    shape: {type: box, center: [1, 1, 0.5], size: [0.2, 0.2, 1], yaw: 20, repeat: {count: 3, step: [0, 1, 0]}}
    texture: {type: plain, color: '#c04020'}
lights:
  - {type: sun, elevation: 48, azimuth: -55, irradiance: 2.6, color: '#fff1dc'}
  - {type: sky, horizon: '#cfdcea', zenith: '#6f9fd8', radiance: 0.7}
appearance: {bounces: 1, spp: 8}
cameras:
  look_at: [0, 0, 0.5]
  radius: 3
  fov: 45
  size: [64, 64]
  source: {yaw: 0, height: 1.5}
  targets:
    - {yaw: 30, height: 1}
edits:
  - name: blue
    instruction: Make it blue
    source: a ball
    target: a blue ball
    changes: [{object: ball, recolor: {'#5c7fc4': '#2040c0'}}]
"""


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("a: 1\n[b, c]: 2\n", 2, "a key is a list or a mapping"),
        ("a: 1\nb: {c: 1, c: 2}\n", 2, "the key 'c' stands here and on line 2"),
        ("a: 1\nb: !!int 'x'\n", 2, "'x' is no int"),
        ("a: !!python/object:os.system x\n", 1, "the tag .*os.system' means nothing here"),
        ("a: 1\nb: {<<: 3}\n", 2, "<<: expected keys with values"),
        ("a: *x\n", 1, "found undefined alias 'x'"),
        ("a: \x07\n", None, "not valid YAML: .*special characters"),
        ("a: [1\nb: 2\n", 2, "check indentation and quotes"),
        ("", None, "the file is empty"),
        pytest.param("[" * 100_000, None, "nested deeper than", id="100,000 levels"),
        pytest.param("a: " + "[" * 150 + "]" * 150, 1, "nested deeper than", id="150 levels"),
        ("x: &x [*x]\n", 1, "nested .* in itself"),
        ("x: &x {<<: *x}\n", None, "nested .* in itself"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_its_line(text, line, message):
    with pytest.raises(YamlError, match=message) as caught:
        read_yaml(text)
    assert caught.value.line == line and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [SCENE, SCENE.replace("radius: 3", "radius:\t3"), *(SCENE[: len(SCENE) * k // 13] for k in range(1, 13))])  # fmt: skip
def test_a_text_means_the_same_without_libyaml(text, monkeypatch):
    def told():
        try:
            return read_yaml(text)
        except YamlError as error:
            return str(error), error.line

    quick = told()
    monkeypatch.setattr(yaml, "__with_libyaml__", False)
    assert told() == quick


def test_aliases_that_repeat_little_mean_what_they_repeat():
    _, data = read_yaml("a: &a [1, 2]\nb: [*a, *a]\nc: {<<: {d: 4}, e: *a}\n")
    assert data == {"a": [1, 2], "b": [[1, 2], [1, 2]], "c": {"d": 4, "e": [1, 2]}}
    _, data = read_yaml("a: &a {x: 1, y: 1}\nb: &b {y: 2, z: 2}\nc: {<<: [*a, *b], x: 3}\n")
    assert data["c"] == {"x": 3, "y": 1, "z": 2}  # own keys, then the first of the list


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ("030", 30), ("0256", 256), ("-007", -7), ("+5", 5), ("09", 9), ("1e3", 1000.0), ("1E-3", 0.001), ("-.5", -0.5),
        ("010.50", 10.5), ("3.", 3.0), (".inf", math.inf), ("-.INF", -math.inf), ("true", True), ("False", False), ("", None), ("~", None),
        *((word, word) for word in ("1:30", "1:30.5", "0b101", "0x1e", "0o17", "1_000", "1_0.5", "yes", "No", "ON", "off", "y", "n", "2024-01-31", "2024-99-99", "1.2.3", "=", ".", "-", "e3", "'030'")),
    ],
)  # fmt: skip
def test_numbers_are_decimal_and_words_are_words(written, meant):
    _, data = read_yaml(f"a: {written}\n030: 1\n" if written != "-" else "a: '-'\n030: 1")
    meant = meant.strip("'") if isinstance(meant, str) else meant
    assert data == {"a": meant, "030": 1} and type(data["a"]) is type(meant)


def test_a_place_has_its_line_through_what_is_merged_and_what_a_union_adds():
    lines, _ = read_yaml("a: &a\n  x: 1\n  y:\n  - 5\n  - 6\nb:\n  <<: *a\n  x: 2\n")
    assert [line_of(lines, loc) for loc in ((), ("a", "y", 1), ("b", "x"))] == [1, 5, 8]
    assert line_of(lines, ("b", "y", 1)) == 5
    assert line_of(lines, ("a", "some-tag", "y", 0)) == 4 and line_of(lines, ("b", "z")) == 6


@pytest.mark.door
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radius: 3", "radius: true", "small.yaml:19: cameras.radius: got true, expected a number"),
        ("source: {yaw: 0", "source: {yaw: 1:30", "small.yaml:22: .*source.yaw: got '1:30', but"),
        ("radius: 3", f"radius: [{'1, ' * 5000}1]", r"radius: got \[1, 1, 1, 1, 1, 1, \.\.\.\]"),
    ],
)
def test_a_scene_names_what_cannot_be_meant_on_one_short_line(tmp_path, old, new, message):
    path = tmp_path / "small.yaml"
    path.write_text(SCENE.replace(old, new, 1))
    with pytest.raises(SceneError, match=message) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_half_a_scene_is_refused_in_one_line_that_names_it(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(SCENE)
    assert load_scene(path).shapes()
    path.write_text(SCENE[: len(SCENE) // 2])
    with pytest.raises(SceneError, match=r"small\.yaml") as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "bare"),
    [
        ("color: #c04020", True), ("colors: [#c04020, b]", True), ("colors: ['#ffffff', #c04020]", True),
        ("  - #c04020", True), ("color: '#c04020'", False), ("# a: #c04020", False),
        ("k: 'v' # see ticket, #123456", False), ("a: b", False),
    ],
)  # fmt: skip
def test_a_colour_without_quotes_is_told_from_a_comment(line, bare):
    assert bool(_bare_color(f"first: 1\n{line}\n")) == bare
