"""One capture of a command line. Oracles: the files that were written, and another library's PSNR."""

import json

import numpy as np
import pytest
import yaml
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio
from small_manifest import write_capture
from typer.testing import CliRunner

from attnwarp_eval.cli.main import app
from attnwarp_eval.study.shared.editing_methods import EDITING_METHODS, EditedScene, Method
from attnwarp_lab.captures.manifest import load_manifest

QUICK = {"steps": 1, "iterations": 2}

MANIFEST = {
    "format": 1,
    "title": "Mine",
    "captures": {},
    "editors": {"picture": "small-plain", "depth": "small-depth"},
    "variants": {
        "every": {"method": "by_view", "editor": "picture", "options": QUICK},
        "staged": {"editor": "picture", "options": {**QUICK, "stages": 1, "views_per_stage": 1}},
        "short": {"method": "by_view", "editor": "picture", "options": {**QUICK, "batch": 1},
                  "budget": {"network_rows": 5}},
        "outside": {"method": "outside", "editor": "picture"},
        "inverted": {"method": "gaussctrl", "editor": "depth",
                     "options": {**QUICK, "source_prompt": "{source}, far"}},
    },
}  # fmt: skip


def swapped(job):
    """A method of a plugin: it turns the colours of the first view, and leaves the splats."""
    picture = np.asarray(job.images[0])[..., ::-1]
    return EditedScene(
        job.gaussians, {0: picture}, {"edit": 1.0}, {"network_rows": 0, "iterations": 0}
    )


def read(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def call(*arguments):
    return CliRunner().invoke(app, ["captures", *map(str, arguments)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture of three views of 32 px, its splats, and a manifest."""
    path = tmp_path_factory.mktemp("capture") / "thing"
    write_capture(path)
    (path / "mine.yaml").write_text(yaml.safe_dump(MANIFEST, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def done(folder):
    out = folder / "out"
    given = (
        folder / "mine.yaml", "--data", folder, "--ply", folder / "scene.ply", "--out", out,
        "--instruction", "make it red", "--target-prompt", "a red bear", "--masks", folder / "masks",
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EDITING_METHODS, "outside", Method(lambda *_: {}, swapped))
        result = call(*given)
        assert result.exit_code == 0, result.output
        times = {path: path.stat().st_mtime_ns for path in (out / "made").rglob("*.png")}
        assert call(*given).exit_code == 0
    assert times == {path: path.stat().st_mtime_ns for path in (out / "made").rglob("*.png")}
    return result, out, json.loads((out / "results.json").read_text())


@pytest.mark.slow
def test_the_figures_are_those_of_the_written_pictures(done, folder):
    _, out, data = done
    cells = {cell["variants"][0]: cell for cell in data["cells"]}
    assert list(cells) == ["every", "staged", "short", "outside"]
    for name, edited, cut in (
        ("every", 3, None), ("staged", 2, None), ("short", 2, "network_rows"), ("outside", 1, None)
    ):  # fmt: skip
        place = out / cells[name]["folder"]
        pictures = {path.name: read(path) for path in (place / "edited").iterdir()}
        assert len(pictures) == edited and cells[name]["cut"] == cut
        values = [
            peak_signal_noise_ratio(pixels, read(place / "renders" / file))
            for file, pixels in pictures.items()
        ]
        figures = cells[name]["figures"]
        assert figures["Edit PSNR, mean of the views"] == pytest.approx(np.mean(values), abs=1e-3)
        assert (place / "run" / "index.html").exists() == (name != "outside")
    assert "CLIP similarity" in figures and "CLIP directional similarity" not in figures
    for k in range(3):
        original = read(out / data["captures"]["thing"]["originals"] / f"view-{k:04d}.png")
        assert (original == read(folder / "images" / f"{k}.png")).all()


@pytest.mark.slow
def test_what_is_left_out_or_cut_is_told_before_and_in_the_report(done):
    result, out, _ = done
    report = (out / "report.md").read_text()
    left_out = "eft out: thing / make it red / inverted: it inverts with the words"
    assert left_out in result.stderr and left_out in report
    assert "**Did not finish within their budget: short.**" in report
    assert "Edits without words for `source` have no CLIP directional similarity." in report
    assert "small-plain was trained on drawn worlds, so photographs are not its world" in report
    assert (out / "report.html").read_text().count("data:image/png") >= 3 * 5


def test_editors_of_ones_own_stand_for_those_of_their_kind_whose_variants_alone_run(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for name in ("ip2p", "base", "control"):
        (tmp_path / name).mkdir()
    loaded = load_manifest(
        "one", {"captures": {"a": {"data": ".", "edits": {"e": {"instruction": "e"}}}}}
    )
    picture = loaded.with_editors(["ip2p"])
    assert list(picture.manifest.variants) == [
        name for name, row in loaded.manifest.variants.items() if row.editor == "picture"
    ]
    assert picture.editor("picture") == str(tmp_path / "ip2p")
    both = loaded.with_editors(["ip2p", "base,control"])
    assert both.editor("depth") == f"{tmp_path / 'base'},{tmp_path / 'control'}"
    assert both.manifest.variants == loaded.manifest.variants


GIVEN = ("--data", ".", "--instruction", "red")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name a manifest, such as paper, or one capture"),
        (["--data", "."], "needs --instruction"),
        (["one", "--at", "1,2"], "--at: needs --data"),
        (["one", "--where", "bear"], "--where: needs --data"),
        ([*GIVEN, "--ply", "none.ply"], "none.ply"),
        ([*GIVEN, "--at", "1"], "--at: got '1', expected X,Y"),
        ([*GIVEN, "--device", "gpu"], "device 'gpu': unknown, expected cpu or cuda"),
        ([*GIVEN, "--editor", "smal"], "editor 'smal': neither bundled"),
        ([*GIVEN, "--variant", "DGF"], "--variant: got 'DGF', expected one of"),
        (["--data", "none", "--instruction", "red", "--variant", "DGE"], "captures.none: "),
        (["mine.yaml", *GIVEN], "variants.outside.method: got 'outside', expected one of"),
    ],
)  # fmt: skip
def test_what_is_missing_is_one_line(folder, monkeypatch, arguments, message):
    monkeypatch.chdir(folder)
    done = call(*arguments)
    assert done.exit_code == 2 and message in done.stderr
    assert done.stderr.removeprefix("checking captures and weights\n").count("\n") == 1
