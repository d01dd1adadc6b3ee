"""The window against VTK's own picking, the keys it lists, and the command."""

from dataclasses import replace

import numpy as np
import pytest
import pyvista
import vtk
from typer.testing import CliRunner

from attnwarp.warp import PRESETS
from attnwarp_eval.cli.main import app
from attnwarp_eval.inspect.cell import CellReport, cell_of, cell_report
from attnwarp_eval.inspect.pair import Pair
from attnwarp_eval.inspect.pixel import report
from attnwarp_eval.inspect.scene import State
from attnwarp_eval.inspect.subject import Subject
from attnwarp_eval.inspect.window import KEYS, Window
from attnwarp_eval.study.schema import Splats

SIZE = 64
STATE = State("corrected", "yaw060")


@pytest.fixture(scope="module")
def window(chosen):
    # Without a graphics card, the 40,000 discs of a study take seconds a picture.
    splats = Splats(count=1000, position_noise=0.1, normal_noise=3.0)
    variants = {name: (variant, splats) for name, (variant, _) in chosen.variants.items()}
    opened = Window(replace(chosen, variants=variants), STATE, off_screen=True, size=(450, 300))
    yield opened
    opened.close()


def shown(window):
    """The numbers on the window, as VTK has them."""
    return window.plotter.renderer.actors["title"].GetText(2)


def click(window, column, row):
    """Pick what VTK finds where a pixel's surface point lies on the screen; whether it is there."""
    plotter, renderer = window.plotter, window.plotter.renderer
    renderer.SetWorldPoint(*window.pair.truth.hits.point[row, column], 1)
    renderer.WorldToDisplay()
    x, y, _ = renderer.GetDisplayPoint()
    left, bottom, right, top = renderer.GetViewport()
    width, height = plotter.window_size
    if not (left * width < x < right * width and bottom * height < y < top * height):
        return False
    picker = vtk.vtkPointPicker()
    picker.SetTolerance(0.002)
    picker.PickFromListOn()
    picker.AddPickList(renderer.actors["seen"])
    picker.Pick(x, y, 0, renderer)
    window._picked_point(None, picker)
    return True


def test_fifty_pixels_picked_on_the_screen_show_the_librarys_numbers(window):
    window.look_through("yaw060")
    pair, tried = window.pair, 0
    redraw, window._draw = window._draw, lambda: None  # each picture costs; the text is drawn below
    try:
        for column, row in np.random.default_rng(3).integers(0, SIZE, (200, 2)).tolist():
            window.picked = None
            if not pair.truth.hits.valid[row, column] or not click(window, column, row):
                continue
            result = window.picked
            assert abs(result.column - column) <= 1 and abs(result.row - row) <= 1
            window._main()
            window._draw_texts()
            text = shown(window)
            pixel = result.row, result.column
            x, y = pair.view.correspondence.xy[pixel].tolist()
            assert f"in the source: ({x:.2f}, {y:.2f}) px" in text
            z = float(pair.world.source.project(pair.truth.hits.point[pixel])[1])
            assert (
                f"exact ({pair.truth.xy[pixel][0]:.2f}, {pair.truth.xy[pixel][1]:.2f}), z {z:.5g}"
                in text
            )
            assert f"depth, truth: {pair.truth.hits.depth[pixel]:.5g}" in text
            for rule, mask in pair.view.rules.items():
                assert f"{'pass' if mask[pixel] else 'FAIL'} {rule}" in text
            assert ("accepted" if pair.view.mask[pixel] else "rejected") in text
            tried += 1
            if tried == 50:
                break
    finally:
        window._draw = redraw
    assert tried == 50


def test_a_pick_on_a_feature_grid_explains_its_cell(window):
    window.show(layer=(16, 16))
    redraw, window._draw = window._draw, lambda: None
    try:
        for column, row in ((30, 40), (12, 50), (63, 63)):
            result = window.pick(column, row)
            expected = cell_report(window.pair, (16, 16), column // 4, row // 4)
            assert isinstance(result, CellReport) and result.lines() == expected.lines()
            assert (column // 4, row // 4) == cell_of(window.pair, (16, 16), column, row)
    finally:
        window._draw = redraw
        window.show(layer=None)
    assert window.picked is None


def test_every_key_that_is_listed_changes_the_picture(window):
    window.look_from_outside()
    actions = window.actions()
    listed = {key for keys in KEYS for key in keys.split(" / ")} - {"click", "q"}
    assert {key.replace("question", "?") for key in actions} == listed
    before = window.plotter.screenshot(return_img=True)
    for key, action in actions.items():
        if key in ("e", "f"):  # no edit here; the flight has a test of its own
            continue
        action()
        after = window.plotter.screenshot(return_img=True)
        assert (before != after).any(), key
        before = after
    window.show(target="yaw060", variant="corrected", coloring="mask", layer=None, splats=False,
                surface=False)  # fmt: skip


def test_a_variant_is_explained_anew_and_another_view_is_not(window):
    window.pick(30, 40)
    window.show(variant="released")
    assert window.picked.verdicts == report(window.pair, 30, 40).verdicts
    assert any(verdict.rule == "photometric" for verdict in window.picked.verdicts)
    window.show(target="yaw030")
    assert window.picked is None
    window.show(target="yaw060", variant="corrected")


def part_of(picture, renderer):
    """The pixels of one part of the window."""
    left, bottom, right, top = renderer.GetViewport()
    height, width = picture.shape[:2]
    rows = slice(round((1 - top) * height), round((1 - bottom) * height))
    return picture[rows, round(left * width) : round(right * width)]


def luminance(colors):
    """Relative luminance of (..., 3) bytes of sRGB, as WCAG 2.2 defines it."""
    value = np.asarray(colors) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


@pytest.mark.parametrize("background", ["white", "black"])
def test_the_legend_is_read_on_light_and_on_dark(window, background):
    plotter, before = window.plotter, window.state
    plotter.window_size = (1024, 768)
    window.show(coloring="rules")
    window._main()
    plotter.set_background(background)
    picture = part_of(plotter.screenshot(return_img=True), plotter.renderer)
    (x, y), (w, h) = (
        f()[:2] for f in (plotter.renderer.legend.GetPosition, plotter.renderer.legend.GetPosition2)
    )
    height, width = picture.shape[:2]
    box = picture[round((1 - y - h) * height) : round((1 - y) * height),
                  round(x * width) : round((x + w) * width)]  # fmt: skip
    legend = window.pair.legend("rules")
    for (text, color), line in zip(legend, np.array_split(box, len(legend)), strict=True):
        symbol, letters = np.split(line.reshape(len(line), -1, 3), [line.shape[1] // 8], axis=1)
        assert (symbol == pyvista.Color(color).int_rgb).all(-1).any(), text
        light = luminance(letters)
        behind = np.median(light)  # letters cover less than half of their line
        contrast = (np.maximum(light, behind) + 0.05) / (np.minimum(light, behind) + 0.05)
        assert contrast.max() >= 4.5, text
    plotter.set_background("white")
    window.show(coloring=before.coloring)
    plotter.window_size = (450, 300)


def test_eight_insets_are_whole_and_their_titles_too(window, monkeypatch):
    """Of a small window; pictures are plain, so that every pixel tells what it belongs to."""
    titles = ["source, not edited", "target, not edited", "scene, stage 10", "source, warped",
              "mask against truth", "features, warped", "true edit", "the last"]  # fmt: skip
    plain = np.tile(np.float32([1, 0, 1]), (24, 32, 1))
    monkeypatch.setattr(Pair, "insets", lambda *_: dict.fromkeys(titles, plain))
    monkeypatch.setattr(Subject, "steps", ("before", "edited"))
    opened = Window(window.subject, STATE, off_screen=True, size=(1024, 768))
    picture = opened.plotter.screenshot(return_img=True)
    insets = [r for r in opened.plotter.renderers if "picture" in r.actors]
    assert len(insets) == 8
    for renderer in insets:
        part = part_of(picture, renderer)[2:-2, 2:-2]  # without the lines between the parts
        rows, columns = np.nonzero((part == (255, 0, 255)).all(-1))
        wide, high = np.ptp(columns) + 1, np.ptp(rows) + 1
        assert wide / high == pytest.approx(32 / 24, rel=0.02)
        assert wide > 0.9 * part.shape[1]
        assert len(rows) == wide * high  # nothing lies over it
        letters_rows, letters_columns = np.nonzero(part.max(-1) < 128)
        assert letters_rows.min() > 0 and letters_rows.max() < rows.min()
        assert np.ptp(letters_rows) >= 7  # capitals and stems, in pixels
        assert letters_columns.max() < part.shape[1] - 2
    opened.close()


def test_a_flight_ends_at_the_target(window):
    pictures = []
    window.fly(lambda: pictures.append(window.plotter.camera.position), steps=4)
    target = window.pair.cameras[1]
    assert len(pictures) == 4 and pictures[-1] == pytest.approx(target.position)
    assert window.plotter.camera.direction == pytest.approx(target.forward, abs=1e-6)
    window.look_from_outside()


def invoke(*arguments):
    return CliRunner().invoke(app, ["inspect", *map(str, arguments)])


def test_the_command_draws_and_explains(tmp_path):
    out = tmp_path / "a.png"
    done = invoke("spheres", "--size", SIZE, "--view", "yaw060", "--pixel", "30,40",
                  "--layer", "8x8", "--screenshot", out)  # fmt: skip
    assert done.exit_code == 0 and "cell (3, 5) of 8 x 8" in done.stdout
    assert pyvista.read(out).dimensions[0] > 1000


def test_the_command_refuses_by_name(tmp_path, folders, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    small, splats = ("spheres", "--size", SIZE), folders / "scene.ply"
    hostile = tmp_path / "run"
    hostile.mkdir()
    (hostile / "study.json").write_text('{"study": {"scenes": ["../../../etc"]}}')
    for arguments, message in (
        ((*small, "--view", "yaw06"), "view: got 'yaw06'; did you mean 'yaw060'?"),
        ((*small, "--variant", "papper"), "variant: got 'papper'; did you mean 'paper'?"),
        ((*small, "--color", "maks"), "--color: got 'maks'; did you mean 'mask'?"),
        ((*small, "--color", "edit disagreement"), "--color: got 'edit disagreement'"),
        ((*small, "--pixel", "30"), "--pixel: got '30', expected COLUMN,ROW"),
        ((*small, "--pixel", "64,3"), "--pixel: pixel: got (64, 3)"),
        ((*small, "--layer", "7"), "--layer: got '7', expected WIDTHxHEIGHT"),
        ((*small, "--layer", "7x7"), "--layer: got '7x7'; expected one of 16x16, 8x8"),
        ((*small, "--scene", "bear"), "so --scene has no meaning"),
        ((*small, "--ply", splats), "--ply: only goes with --data"),
        ((*small, "--step", "edited"), "--step: got 'edited'"),
        (("sphere",), "spheres"),
        ((splats,), "needs cameras; name them with --data FOLDER"),
        ((splats, "--data", tmp_path), "transforms.json"),
        ((splats, "--data", folders, "--color", "endpoint error"), "got 'endpoint error'"),
        ((tmp_path / "none.ply", "--data", folders), "none.ply"),
        ((hostile,), "study.json"),
        (small, "no display; draw a picture with --screenshot FILE"),
        ((*small, "--export", tmp_path / "a.stl"), "got .stl, expected .html, .glb or .vtp"),
    ):
        failed = invoke(*arguments)
        assert failed.exit_code == 2 and message in failed.stderr, (arguments, failed.stderr)
        assert failed.stderr.count("\n") == 1


def test_presets_of_a_scene_are_those_of_the_library(chosen):
    assert set(chosen.variants) == set(PRESETS)
    for name, (variant, _) in chosen.variants.items():
        assert variant.settings() == PRESETS[name]
