"""The window against VTK's own picking, the keys it lists, and the command."""

from dataclasses import replace

import numpy as np
import pytest
import pyvista
import scipy.ndimage
from typer.testing import CliRunner

from attnwarp.warp import PRESETS
from attnwarp_eval.cli.main import app
from attnwarp_eval.inspect import scene, subject
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
    opened.enable_picking()
    opened.plotter.screenshot(return_img=True)  # a person clicks on what is drawn
    yield opened
    opened.close()


def shown(window):
    """The numbers on the window, as VTK has them."""
    return window.plotter.renderer.actors["title"].GetText(2)


def click(window, column, row):
    """Press and release the left button where a position of the target's picture is on the screen,
    while the view is the target's own."""
    window._main()
    renderer, interactor = window.plotter.renderer, window.plotter.iren.interactor
    left, bottom = renderer.GetOrigin()
    width, height = renderer.GetSize()
    # A square picture in the middle of the view, as high as the view.
    x = left + width / 2 + (column / SIZE - 0.5) * height
    y = bottom + height * (1 - row / SIZE)
    interactor.SetEventInformation(round(x), round(y), 0, 0)
    interactor.LeftButtonPressEvent()
    interactor.LeftButtonReleaseEvent()


def beside_nearer_surface(depth, pixels):
    """Mask of pixels with something nearer within so many pixels."""
    low = scipy.ndimage.minimum_filter(np.nan_to_num(depth, nan=np.inf), 2 * pixels + 1)
    return low < 0.9 * depth


def beside_an_edge(hits):
    """Mask of pixels with another surface, the sky, or the picture's border within a pixel."""
    depth = np.pad(np.where(hits.valid, hits.depth, np.inf), 1, constant_values=np.inf)
    owner = np.pad(hits.object_id, 1, mode="edge")
    low, high = (f(depth, 3) for f in (scipy.ndimage.minimum_filter, scipy.ndimage.maximum_filter))
    mixed = scipy.ndimage.minimum_filter(owner, 3) != scipy.ndimage.maximum_filter(owner, 3)
    return ((high > 1.04 * low) | mixed)[1:-1, 1:-1]


@pytest.mark.parametrize("number", [20, pytest.param(50, marks=pytest.mark.slow)])
def test_pixels_picked_on_the_screen_show_the_librarys_numbers(window, number):
    window.look_through("yaw060")
    pair, tried = window.pair, 0
    hard = beside_nearer_surface(pair.truth.hits.depth, 2)
    edge = beside_an_edge(pair.truth.hits)
    random = np.random.default_rng(3)
    # The first ten are behind the edge of something nearer, which a coarse picker would prefer.
    places = random.permutation(np.argwhere(hard & ~edge))[:10].tolist()
    assert len(places) == 10
    places += random.integers(0, SIZE, (200, 2)).tolist()
    redraw, window._draw = window._draw, lambda: None  # each picture costs; the text is drawn below
    try:
        for row, column in places:
            window.picked = None
            click(window, column + 0.5, row + 0.5)
            if window.picked is None:  # the sky, or the half of a pixel along an edge
                assert edge[row, column]
                continue
            result = window.picked
            assert (result.column, result.row) == (column, row)
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
            if tried == number:
                break
    finally:
        window._draw = redraw
    assert tried == number


def test_a_slider_moved_changes_what_is_shown(window):
    window._add_sliders()
    for name, attribute, index, expected in (
        ("view", "target", 1, window.targets[1]),
        ("variant", "variant", 2, "released"),
        ("layer", "layer", 2, (8, 8)),
    ):
        slider = window._sliders[name][0]
        slider.GetRepresentation().SetValue(index)
        slider.InvokeEvent("EndInteractionEvent")
        assert getattr(window.state, attribute) == expected
        assert slider.GetRepresentation().GetTitleText().startswith(f"{name}: ")
    window.plotter.clear_slider_widgets()
    window._sliders.clear()
    window.show(target="yaw060", variant="corrected", layer=None)


@pytest.mark.parametrize("key", [*"evpfswri3uq", "Up", "plus"])
def test_a_key_does_what_is_listed_and_nothing_of_vtks_or_pyvistas(window, key):
    """Among theirs, e closes the window, v turns the view, w draws wires, 3 is for red-blue
    glasses.
    """
    window._replace_keys()
    called, plotter = [], window.plotter
    callbacks = plotter.iren._key_press_event_callbacks
    for name in list(callbacks):
        callbacks[name] = [lambda name=name: called.append(name)]
    interactor = plotter.iren.interactor
    ended = []
    observer = interactor.AddObserver("ExitEvent", lambda *_: ended.append(True))
    before = plotter.screenshot(return_img=True)
    interactor.SetKeyEventInformation(0, 0, key[0], 0, key)
    interactor.KeyPressEvent()
    interactor.CharEvent()
    interactor.RemoveObserver(observer)
    listed = {name for names in KEYS for name in names.split(" / ")}
    assert called == [key] * (key in listed) and not ended
    assert (plotter.screenshot(return_img=True) == before).all()


@pytest.mark.parametrize("coloring", ["mask", "picture"])
def test_through_the_target_each_pixel_has_its_colour(window, coloring):
    """No picture is between the target camera and what it sees."""
    window.picked = None
    window.show(coloring=coloring, target="yaw060")
    window.look_through("yaw060")
    picture = part_of(window.plotter.screenshot(return_img=True), window.plotter.renderer)
    height, width = picture.shape[:2]
    y, x = np.indices((SIZE, SIZE)) + 0.5
    columns = np.floor(width / 2 + (x / SIZE - 0.5) * height).astype(int)
    actual = picture[np.floor(y / SIZE * height).astype(int), columns]
    expected = 255 * window.pair.colors(coloring)
    # The surface is drawn from one pixel's centre to the next; texts and the legend lie above it.
    inner = ~beside_an_edge(window.pair.truth.hits)
    inner[: SIZE // 4], inner[-SIZE // 8 :] = False, False
    close = abs(actual - expected).max(axis=2) < 40
    assert inner.sum() > 500 and close[inner].mean() > 0.95
    window.show(coloring="mask")
    window.look_from_outside()


@pytest.mark.parametrize("size", [(450, 300), (300, 450)])
def test_both_frusta_are_in_the_view_from_outside(window, size):
    opened = Window(window.subject, STATE, off_screen=True, size=size)
    opened.plotter.screenshot(return_img=True)
    opened._main()
    renderer = opened.plotter.renderer
    (left, bottom), (width, height) = renderer.GetOrigin(), renderer.GetSize()
    positions = []
    for name in ("source frustum", "target frustum"):
        for point in opened.plotter.actors[name].mapper.dataset.points:
            renderer.SetWorldPoint(*point, 1)
            renderer.WorldToDisplay()
            x, y, _ = renderer.GetDisplayPoint()
            positions.append(((x - left) / width, (y - bottom) / height))
    opened.close()
    # A tenth is left on every side, and no more of the tighter ones.
    assert np.min(positions) >= 0.099 and np.max(positions) <= 0.901
    assert np.max(abs(np.array(positions) - 0.5)) == pytest.approx(0.4, abs=0.02)


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
    """Insets of a small window; pictures are plain, so that every pixel tells what it belongs
    to.
    """
    titles = ["source, not edited", "target, not edited", "scene, stage 10", "source, warped",
              "mask against truth", "scene, before", "true edit", "the last"]  # fmt: skip
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


def test_while_the_view_moves_large_meshes_are_light_and_a_click_finds_its_pixel(
    window, monkeypatch
):
    monkeypatch.setattr(scene, "MOVING", 400)  # of 1,000 discs and some 3,000 faces
    window.show(variant="corrected", target="yaw060", coloring="rules", layer=None, splats=True)
    renderer, mouse = window.plotter.renderer, window.plotter.iren.interactor
    names = ("seen", "moving seen", "discs", "moving discs")

    def visible():
        actors = renderer.actors
        return [name in actors and bool(actors[name].visibility) for name in names]

    # Nothing is made for a movement before there is one.
    assert not {"moving seen", "moving discs"} & set(renderer.actors.keys())
    assert visible() == [True, False, True, False]
    colors, calls = Pair.colors, []
    monkeypatch.setattr(Pair, "colors", lambda *given: calls.append(given) or colors(*given))
    samples = window.plotter.render_window.GetMultiSamples()
    mouse.SetEventInformation(300, 150, 0, 0)
    mouse.MiddleButtonPressEvent()
    assert visible() == [True, False, False, True]
    mouse.SetEventInformation(320, 160, 0, 0)
    mouse.MouseMoveEvent()
    assert visible() == [False, True, False, True]
    assert window.plotter.render_window.GetMultiSamples() == 0
    window.plotter.render()  # VTK fills a mapper when it draws
    meshes = {name: renderer.actors[name].mapper.dataset for name in names}
    assert 100 < meshes["moving seen"].n_cells <= 400 < meshes["seen"].n_cells
    mouse.MiddleButtonReleaseEvent()
    assert visible() == [True, False, True, False]
    assert window.plotter.render_window.GetMultiSamples() == samples
    # Points of the coarse surface are the surface's own, with their colours.
    every = {tuple(p): tuple(c) for p, c in coloured(meshes["seen"])}
    coarse = {tuple(p): tuple(c) for p, c in coloured(meshes["moving seen"])}
    assert coarse.items() <= every.items()
    assert calls == []  # those colours are the mesh's, not computed again
    # One point a disc, on it.
    corners = np.asarray(meshes["discs"].points).reshape(1000, -1, 3)
    assert np.array_equal(meshes["moving discs"].points, corners[:, 0])

    window.show(splats=False)
    assert "moving discs" not in window.plotter.renderer.actors
    window.look_through("yaw060")
    window.plotter.screenshot(return_img=True)
    window.picked = None
    click(window, 30.5, 40.5)
    assert (window.picked.column, window.picked.row) == (30, 40)
    monkeypatch.undo()
    window.show(coloring="mask")
    assert "moving seen" not in window.plotter.renderer.actors
    window.picked = None
    window.look_from_outside()


def coloured(mesh):
    return zip(np.asarray(mesh.points).tolist(), mesh.point_data["colors"].tolist(), strict=True)


def test_a_flight_ends_at_the_target(window):
    pictures = []
    window.fly(lambda: pictures.append(window.plotter.camera.position), steps=4)
    target = window.pair.cameras[1]
    assert len(pictures) == 4 and pictures[-1] == pytest.approx(target.position)
    assert window.plotter.camera.direction == pytest.approx(target.forward, abs=1e-6)
    window.look_from_outside()


def invoke(*arguments):
    return CliRunner().invoke(app, ["inspect", *map(str, arguments)])


def test_a_pair_is_made_once_for_numbers_file_and_window(tmp_path, folders, monkeypatch):
    made = []
    monkeypatch.setattr(
        subject, "Pair", lambda *given, **more: made.append(given[1]) or Pair(*given, **more)
    )
    words = (folders / "scene.ply", "--data", folders, "--view", "3", "--pixel", "16,16")
    done = invoke(*words, "--export", tmp_path / "a.glb", "--screenshot", tmp_path / "a.png")
    assert done.exit_code == 0 and made == ["3"]


def test_the_command_draws_and_explains(tmp_path):
    out = tmp_path / "a.png"
    done = invoke("spheres", "--size", SIZE, "--view", "yaw060", "--pixel", "30,40",
                  "--layer", "8x8", "--screenshot", out)  # fmt: skip
    assert done.exit_code == 0 and "cell (3, 5) of 8 x 8" in done.stdout
    assert pyvista.read(out).dimensions[0] > 1000


def test_without_a_display_the_numbers_of_a_pixel_are_the_answer(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    done = invoke("spheres", "--size", SIZE, "--view", "yaw060", "--pixel", "30,40")
    assert done.exit_code == 0 and "pixel (30, 40)" in done.stdout and not done.stderr


def test_the_command_refuses_by_name(tmp_path, folders, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    small, splats = ("spheres", "--size", SIZE), folders / "scene.ply"
    hostile = tmp_path / "run"
    hostile.mkdir()
    (hostile / "study.json").write_text('{"study": {"scenes": ["../../../etc"]}}')
    for arguments, message in (
        ((*small, "--view", "yaw06"), "view: got 'yaw06'; did you mean 'yaw060'?"),
        ((*small, "--color", "maks"), "--color: got 'maks'; did you mean 'mask'?"),
        ((*small, "--color", "edit disagreement"), "--color: got 'edit disagreement'"),
        ((*small, "--pixel", "64,3"), "--pixel: got (64, 3)"),
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
        ((*small, "--screenshot", tmp_path / "a.jpg"), "a.jpg, expected a name that ends in .png"),
        ((*small, "--export", tmp_path / "a.stl"), "got .stl, expected .html or .glb"),
    ):
        failed = invoke(*arguments)
        assert failed.exit_code == 2 and message in failed.stderr, (arguments, failed.stderr)
        assert failed.stderr.count("\n") == 1


def test_presets_of_a_scene_are_those_of_the_library(chosen):
    assert set(chosen.variants) == set(PRESETS)
    for name, (variant, _) in chosen.variants.items():
        assert variant.settings() == PRESETS[name]
