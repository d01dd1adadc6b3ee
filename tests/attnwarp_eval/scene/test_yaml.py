"""YAML from people: what cannot be meant is refused in one line, with its place, at once."""

from pathlib import Path

import pytest
import yaml
from damage_files import mutate_bytes, mutate_text, survey

import attnwarp_eval
from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.scene.scene import SceneError
from attnwarp_eval.scene.yaml import (
    DEEPEST,
    EXACT,
    FAST,
    MOST_VALUES,
    YamlError,
    _bare_color,
    _read,
    read_yaml,
)

BOMB = "a: &a [1, 2, 3, 4, 5, 6, 7, 8, 9]\n" + "".join(
    f"{name}: &{name} [{', '.join(['*' + above] * 9)}]\n"
    for above, name in zip("abcdefgh", "bcdefghi", strict=True)
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
        ("a: 1\n? {b: c}\n: 2\n", 2, "a key is a list or a mapping"),
        ("a: 1\nb: {c: 1, c: 2}\n", 2, "the key 'c' stands here and on line 2"),
        ("a:\n  - 2024-99-99\n", 2, "'2024-99-99' is no timestamp"),
        ("a: 1\nb: !!int 'x'\n", 2, "'x' is no int"),
        ("a: !!float 'x'\n", 1, "'x' is no float"),
        ("a: !!bool 'x'\n", 1, "'x' is no bool"),
        ("a: !!timestamp 'x'\n", 1, "'x' is no timestamp"),
        ("a: !!python/object:os.system x\n", 1, "could not determine a constructor"),
        (f"a: 1\nb: {'7' * 5000}\n", 2, "'7777777.* is no int"),
        ("a: " + "[" * 5000 + "]" * 5000, 1, f"nested deeper than {DEEPEST} levels"),
        ("a: " + "{b: " * 5000 + "1" + "}" * 5000, 1, f"nested deeper than {DEEPEST} levels"),
        ("a: &x [1, *x]\n", 1, r"\*x stands for what it is part of"),
        ("a: &x\n  b: {c: *x}\n", 2, r"\*x stands for what it is part of"),
        (BOMB, 6, f"means more than {MOST_VALUES:,} values"),
        ("a: *x\n", 1, "found undefined alias 'x'"),
        ('a: "\\UFFFFFFFF"\n', None, "not valid YAML"),
        ("a: \x07\n", None, "not valid YAML: .*special characters"),
        ("a: [1\nb: 2\n", 2, "check indentation and quotes"),
        ("", None, "the file is empty"),
        ("#" * (2**20 + 1), None, "has 1,048,577 characters"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_its_line(text, line, message):
    with pytest.raises(YamlError, match=message) as caught:
        read_yaml(text)
    assert caught.value.line == line and "\n" not in str(caught.value)


def test_aliases_that_repeat_little_mean_what_they_repeat():
    _, data = read_yaml("a: &a [1, 2]\nb: [*a, *a]\nc: {<<: {d: 4}, e: *a}\n")
    assert data == {"a": [1, 2], "b": [[1, 2], [1, 2]], "c": {"d": 4, "e": [1, 2]}}


@pytest.mark.door
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radius: 3", "radius: yes", r"small.yaml:19: cameras.radius: got true, expected a number"),
        ("radius: 3", "radius: 1e30", r"small.yaml:19: cameras.radius: got '1e30', but input"),
        ("radius: 3", "radius: !!int x", "small.yaml:19: 'x' is no int"),
        ("radius: 3", f"radius: [{'1, ' * 5000}1]", r"radius: got \[1, 1, 1, 1, 1, 1, \.\.\.\]"),
    ],
)
def test_a_scene_names_what_cannot_be_meant_on_one_short_line(tmp_path, old, new, message):
    path = tmp_path / "small.yaml"
    path.write_text(SCENE.replace(old, new, 1))
    with pytest.raises(SceneError, match=message) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def loaded(case):
    path, data = case
    path.write_bytes(data)
    scene = load_scene(path)
    assert scene.cameras and scene.content_hash and scene.shapes()


def survey_scenes(folder, count):
    path = folder / "small.yaml"
    cases = [
        (f"text {seed}", (path, mutate_text(SCENE, seed).encode("utf-8", "surrogatepass")))
        for seed in range(count)
    ]
    cases += [
        (f"bytes {seed}", (path, mutate_bytes(SCENE.encode(), seed))) for seed in range(count // 4)
    ]
    outcomes = survey(cases, loaded, refusals=(SceneError,))
    assert not [outcome for outcome in outcomes if outcome.failed]
    return [outcome.kind for outcome in outcomes]


def test_damaged_scenes_are_refused_in_one_line_or_are_scenes(tmp_path):
    loaded((tmp_path / "small.yaml", SCENE.encode()))
    kinds = survey_scenes(tmp_path, 32)
    assert len(kinds) == 40 and kinds.count("refused") > 15


@pytest.mark.slow
def test_many_damaged_scenes_are_refused_in_one_line_or_are_scenes(tmp_path):
    assert len(survey_scenes(tmp_path, 320)) == 400


@pytest.mark.skipif(FAST is None, reason="PyYAML without libyaml")
def test_libyaml_and_pythons_parser_read_shipped_files_alike():
    root = Path(attnwarp_eval.__file__).parents[2]
    files = [*root.glob("eval/**/*.yaml"), *root.glob("scenes/[a-f]*.yaml")]
    assert len(files) > 20

    def lines(node):
        if isinstance(node, yaml.MappingNode):
            return [(key.value, key.start_mark.line, lines(value)) for key, value in node.value]
        if isinstance(node, yaml.SequenceNode):
            return [(item.start_mark.line, lines(item)) for item in node.value]
        return node.value

    for path in files:
        text = path.read_text(encoding="utf-8")
        (fast, values), (exact, same) = _read(text, FAST), _read(text, EXACT)
        assert values == same, path
        assert lines(fast) == lines(exact), path


@pytest.mark.parametrize(
    "text",
    ["title: !\n", "\n\ufeffname: a\n", "name:\ta\n", "a: !!int ''\n", "a: 1\t\n", "a: 'b!'\n"],
)
def test_what_the_two_parsers_would_read_otherwise_is_read_by_pythons_alone(text):
    def outcome(read):
        try:
            return read()
        except YamlError as error:
            return str(error), error.line

    exact = outcome(lambda: _read(text, EXACT)[1])
    assert outcome(lambda: read_yaml(text)[1]) == exact


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
