"""`attnwarp-eval metrics` on a person's own pictures, and `attnwarp-eval encoders`."""

import json
import math
import re
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
import tiny_models
from further import further
from PIL import Image, ImageOps
from torch_threads import on_one_thread
from typer.testing import CliRunner

from attnwarp.encoders import bundled
from attnwarp_eval.cli.main import app
from attnwarp_eval.encoders import load_encoder
from attnwarp_eval.metrics.registry import METRICS, metric
from attnwarp_eval.user_images import measure
from attnwarp_eval.user_images.measure import BATCH, inside, read_picture

VIEWS = ("view1", "view2", "view10")
PROMPTS = ("--prompt", "a bear in the snow", "--source-prompt", "a photo of a bear")


one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Real formats, small random weights."""
    folder = tmp_path_factory.mktemp("models")
    for name in ("clip", "dino", "lpips"):
        (folder / name).mkdir()
    tiny_models.save_clip(folder / "clip")
    tiny_models.save_dino(folder / "dino", registers=True)
    tiny_models.save_backbone(folder / "lpips" / "alexnet-owt-7be5be79.pth", "alex")
    linear = tiny_models.linear_layers() / "alex.pth"
    (folder / "lpips" / "alex.pth").write_bytes(linear.read_bytes())
    return {
        "clip": f"clip:{folder / 'clip'}",
        "dino": f"dinov2:{folder / 'dino'}",
        "perceptual": f"lpips:{folder / 'lpips'}",
    }


def random_picture(random, shape=(40, 48)):
    return random.integers(0, 256, (*shape, 3), dtype=np.uint8)


def write(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    order = [2, 1, 0, 3][: rgb.shape[2]] if rgb.ndim == 3 else slice(None)
    assert cv2.imwrite(str(path), rgb[..., order] if rgb.ndim == 3 else rgb)
    return path


@pytest.fixture
def data(tmp_path):
    """Three views, three ways of naming the same picture's kind, and the arrays behind them."""
    random = np.random.default_rng(0)
    arrays = {
        group: {v: random_picture(random) for v in VIEWS}
        for group in ("renders", "edited", "originals")
    }
    for group, suffix in (("renders", "png"), ("edited", "tif"), ("originals", "PNG")):
        for view, picture in arrays[group].items():
            write(tmp_path / group / f"{view}.{suffix}", picture)
    arrays["source"] = random_picture(random, (30, 64))
    write(tmp_path / "edit.png", arrays["source"])
    return tmp_path, arrays


def call(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def everything(folder, models, *more):
    options = [f"--{group}={folder / group}" for group in ("renders", "edited", "originals")]
    chosen = [f"--{kind}={name}" for kind, name in models.items()]
    out = ["--out", folder / "out"] if "--out" not in more else []
    return call(
        "metrics", *options, f"--source-edit={folder / 'edit.png'}", *PROMPTS, *chosen, *out, *more
    )


def pixels(folder, *more, out="out"):
    """The command on renders and edited pictures alone."""
    folders = [f"--{group}={folder / group}" for group in ("renders", "edited")]
    return call("metrics", *folders, *more, "--out", folder / out)


def saved(folder):
    return json.loads((folder / "out" / "metrics.json").read_text())


def cosine(a, b):
    return float((a * b).sum() / np.linalg.norm(a) / np.linalg.norm(b))


def test_the_whole_row_is_what_the_encoders_and_pixels_give(data, models):
    folder, arrays = data
    done = everything(folder, models)
    assert done.exit_code == 0, done.output
    result = saved(folder)["metrics"]
    renders, edited, originals = (
        {v: a.astype(np.float64) / 255 for v, a in arrays[g].items()}
        for g in ("renders", "edited", "originals")
    )
    errors = [((edited[v] - renders[v]) ** 2).mean() for v in VIEWS]
    expected = {v: -10 * math.log10(e) for v, e in zip(VIEWS, errors, strict=True)}
    assert list(result["edit.psnr_mean"]["views"]) == list(VIEWS)  # view2 before view10
    assert result["edit.psnr_mean"]["views"] == pytest.approx(expected, abs=1e-4)
    assert result["edit.psnr_mean"]["value"] == pytest.approx(
        np.mean(list(expected.values())), abs=1e-4
    )
    assert result["edit.psnr_pooled"]["value"] == pytest.approx(
        -10 * math.log10(np.mean(errors)), abs=1e-4
    )

    clip, dino = load_encoder(models["clip"]), load_encoder(models["dino"])
    (source,) = clip.images([arrays["source"] / 255])
    target, before = clip.texts([PROMPTS[1], PROMPTS[3]])
    unit = lambda v: v / np.linalg.norm(v)  # noqa: E731
    for v in VIEWS:
        (now,), (was,) = clip.images([renders[v]]), clip.images([originals[v]])
        for key, value in (
            ("clip_similarity", cosine(now, target)),
            ("clip_image", cosine(now, source)),
            ("clip_directional", cosine(unit(now) - unit(was), unit(target) - unit(before))),
            (
                "dino_image",
                cosine(dino.images([renders[v]]), dino.images([arrays["source"] / 255])),
            ),
        ):
            assert result[f"embedding.{key}"]["views"][v] == pytest.approx(value, abs=1e-4)
    lpips = load_encoder(models["perceptual"]).distance(
        list(edited.values()), list(renders.values())
    )
    assert result["perceptual.distance"]["value"] == pytest.approx(lpips.mean(), rel=1e-4)
    change = [
        unit(clip.images([renders[v]])[0]) - unit(clip.images([originals[v]])[0]) for v in VIEWS
    ]
    neighbours = result["embedding.direction_consistency"]["views"]
    assert list(neighbours) == ["view1 to view2", "view2 to view10"]
    assert list(neighbours.values()) == pytest.approx(
        [cosine(change[0], change[1]), cosine(change[1], change[2])], abs=1e-4
    )
    for key, row in result.items():
        assert (row["unit"], row["direction"]) == (metric(key).unit, metric(key).direction)
        # Between random pictures there is no drift to tell.
        told = {"embedding.direction_consistency": 2, "edit.drift": 0}
        assert row["n"] == told.get(key, 3)


def test_what_is_saved_says_what_was_measured_with_what(data, models):
    folder, _ = data
    done = everything(folder, models)
    about = saved(folder)
    assert about["inputs"]["prompt"] == PROMPTS[1] and about["inputs"]["renders"] == str(
        folder / "renders"
    )
    for kind in ("clip", "dino", "perceptual"):
        assert about["encoders"][kind] == json.loads(
            json.dumps(load_encoder(models[kind]).about.to_dict())
        )
    text = (folder / "out" / "metrics.md").read_text()
    for expected in (
        "| Edit PSNR, pooled |", "| CLIP directional similarity |", "| view10 |", about["encoders"]["clip"]["weights_sha256"],
        "shorter edge to 32 px (bicubic",
    ):  # fmt: skip
        assert expected in text
    assert not about["not_computed"] and not about["unpaired"]
    for title in (
        "Edit PSNR, mean of the views",
        "DINO single-image similarity",
        "Perceptual distance",
    ):
        assert title in done.stdout
    assert str(folder / "out" / "metrics.json") in done.stdout.replace("\n", "")


def test_json_goes_to_stdout_alone(data, models):
    folder, _ = data
    done = everything(folder, models, "--json")
    assert json.loads(done.stdout) == saved(folder)
    assert "metrics.md" in done.stderr


@pytest.mark.parametrize(
    "left_out, reasons",
    further(
        (
            "edited",
            {
                title: "needs --edited"
                for title in ("Edit PSNR", "Perceptual distance", "Drift of the edit")
            },
        ),
        (
            "prompt",
            {"CLIP similarity": "needs --prompt", "CLIP directional similarity": "needs --prompt"},
        ),
    ),
)
def test_what_is_left_out_costs_its_figures_and_the_reason_is_said(data, models, left_out, reasons):
    folder, _ = data
    options = {
        "renders": folder / "renders",
        "edited": folder / "edited",
        "originals": folder / "originals",
        "source-edit": folder / "edit.png",
        "prompt": PROMPTS[1],
        "source-prompt": PROMPTS[3],
        "out": folder / "out",
    } | models
    done = call(
        "metrics", *(f"--{name}={value}" for name, value in options.items() if name != left_out)
    )
    assert done.exit_code == 0, done.output
    assert saved(folder)["not_computed"] == reasons
    for title, reason in reasons.items():
        assert f"not computed: {title}: {reason}" in done.stderr
    assert len(saved(folder)["metrics"]) == 9 - len(reasons) - (
        "Edit PSNR" in reasons
    )  # Edit PSNR has two rows


def test_the_folder_of_a_study_is_refused(data):
    folder, _ = data
    (folder / "run").mkdir()
    (folder / "run" / "study.json").write_text("{}")
    done = pixels(folder, out="run")
    assert done.exit_code == 2 and "is the run of a study" in done.stderr
    assert [path.name for path in (folder / "run").iterdir()] == ["study.json"]


def test_pixels_alone_need_no_encoder(data):
    folder, _ = data
    off = ("--clip=none", "--dino=none", "--perceptual=none")
    done = pixels(folder, *off)
    assert done.exit_code == 0, done.output
    assert (
        set(saved(folder)["metrics"]) == {"edit.psnr_mean", "edit.psnr_pooled"}
        and saved(folder)["encoders"] == {}
    )
    assert saved(folder)["not_computed"]["Perceptual distance"] == "left out by --perceptual none"


def test_a_metric_of_ones_own_is_a_row_of_the_registry(data, monkeypatch):
    """Oracle: the mean squared difference of the arrays that were written."""
    folder, arrays = data
    own = replace(
        METRICS["image.mse"], column="Mean squared change", pictures=("originals", "renders"),
        function="attnwarp_eval.metrics.image:mse",
    )  # fmt: skip
    monkeypatch.setitem(METRICS, own.name, own)
    (folder / "originals/view2.PNG").unlink()
    options = ["--originals", folder / "originals", "--clip=none", "--dino=none"]
    for _ in range(2):  # computed, then read from its cell
        done = pixels(folder, "--perceptual=none", *options)
        assert done.exit_code == 0 and "Mean squared change" in done.output
        row = saved(folder)["metrics"]["image.mse"]
        expected = {
            view: ((arrays["renders"][view] / 255 - arrays["originals"][view] / 255) ** 2).mean()
            for view in ("view1", "view10")
        }
        assert row["views"] == pytest.approx(expected, rel=1e-5)
        assert row["value"] == pytest.approx(np.mean([*expected.values()]), rel=1e-5)
    done = pixels(folder, "--perceptual=none", out="less")
    assert "Mean squared change: needs --originals" in done.output


def test_pictures_without_a_partner_are_named_and_left_out(data, models):
    folder, _ = data
    (folder / "edited" / "view2.tif").unlink()
    write(folder / "edited" / "extra.tif", np.zeros((4, 4, 3), np.uint8))
    done = everything(folder, models)
    assert done.exit_code == 0, done.output
    assert "1 of --renders without one in --edited: view2" in done.stderr
    assert "1 of --edited without one in --renders: extra" in done.stderr
    result = saved(folder)["metrics"]
    assert list(result["edit.psnr_mean"]["views"]) == ["view1", "view10"]
    assert list(result["embedding.clip_similarity"]["views"]) == list(VIEWS)


@pytest.mark.parametrize("renders", [0, 1])
def test_pictures_without_renders_have_the_figures_that_need_none(tmp_path, renders):
    random = np.random.default_rng(0)
    scene = cv2.GaussianBlur(random_picture(random, (96, 120)), (0, 0), 1.5)
    for view in VIEWS:
        write(tmp_path / "originals" / f"{view}.png", scene)
        write(tmp_path / "edited" / f"{view}.png", np.roll(scene, 2, axis=1))
    for view in VIEWS[:renders]:
        write(tmp_path / "renders" / f"{view}.png", scene)
    folders = ("originals", "edited", *["renders"] * renders)
    options = [f"--{group}={tmp_path / group}" for group in folders]
    options += ["--clip=none", "--perceptual=none", f"--out={tmp_path / 'out'}"]
    result = call("metrics", *options)
    assert result.exit_code == 0, result.output
    drift = json.loads((tmp_path / "out" / "metrics.json").read_text())["metrics"]["edit.drift"]
    # Every picture moves by two pixels.
    assert drift["views"] == pytest.approx(dict.fromkeys(VIEWS, 2.0), abs=0.1)
    write(tmp_path / "edited" / "view2.png", scene[:40])
    result = call("metrics", *options)
    assert result.exit_code == 2 and "is 120 x 40 px, but" in result.stderr


@pytest.mark.door
@pytest.mark.parametrize("group, suffix", [("masks", "png")])
def test_a_pair_of_different_sizes_names_both(data, models, group, suffix):
    folder, _ = data
    for view in VIEWS:
        write(folder / "masks" / f"{view}.png", np.full((40, 48), 255, np.uint8))
    write(folder / group / f"view2.{suffix}", np.zeros((20, 24, 3), np.uint8))
    done = everything(folder, models, f"--mask={folder / 'masks'}")
    assert done.exit_code == 2
    for part in (
        f"{group}/view2.{suffix} is 24 x 20 px, but ",
        "view2.png is 48 x 40: a pair must have one size",
    ):
        assert part in done.stderr


def test_views_beyond_one_batch_and_pairs_with_holes_keep_their_own_values(tmp_path, models):
    random = np.random.default_rng(1)
    names = [f"{i}" for i in range(2 * BATCH + 1)]
    sizes = {
        name: (40, 48) if int(name) % 3 else (50, 36) for name in names
    }  # sizes differ from view to view
    arrays = {
        g: {n: random_picture(random, sizes[n]) for n in names}
        for g in ("renders", "edited", "originals")
    }
    here = {"renders": names, "edited": names[1::2], "originals": names[2::3]}
    for group, some in here.items():
        for name in some:
            write(tmp_path / group / f"{name}.png", arrays[group][name])
    write(tmp_path / "edit.png", arrays["edited"]["1"])
    assert everything(tmp_path, models).exit_code == 0
    result = saved(tmp_path)["metrics"]
    clip = load_encoder(models["clip"])
    (source,) = clip.images([arrays["edited"]["1"] / 255])
    expected = {n: cosine(clip.images([arrays["renders"][n] / 255])[0], source) for n in names}
    assert result["embedding.clip_image"]["views"] == pytest.approx(expected, abs=1e-5)
    assert list(result["embedding.clip_directional"]["views"]) == here["originals"]
    errors = {
        n: (((arrays["edited"][n] / 255.0) - (arrays["renders"][n] / 255.0)) ** 2).mean()
        for n in here["edited"]
    }
    expected = {n: -10 * math.log10(e) for n, e in errors.items()}
    assert result["edit.psnr_mean"]["views"] == pytest.approx(expected, abs=1e-4)
    assert result["edit.psnr_pooled"]["value"] == pytest.approx(
        -10 * math.log10(np.mean(list(errors.values()))), abs=1e-4
    )


def test_a_view_alike_to_its_picture_is_counted_apart(data, models):
    folder, arrays = data
    for view in ("view1", "view10"):
        write(folder / "edited" / f"{view}.tif", arrays["renders"][view])
    everything(folder, models)
    row = saved(folder)["metrics"]["edit.psnr_mean"]
    assert row["identical"] == ["view1", "view10"] and row["views"]["view1"] == "inf"
    assert row["value"] == row["views"]["view2"]
    assert saved(folder)["metrics"]["perceptual.distance"]["views"]["view1"] == 0
    assert any("2 edited pictures equal their renders" in note for note in saved(folder)["notes"])


def test_a_figure_undefined_everywhere_is_too_little(data):
    folder, _ = data
    for path in (folder / "masks" / f"{v}.png" for v in VIEWS):
        write(path, np.zeros((40, 48), np.uint8))
    done = pixels(folder, f"--mask={folder / 'masks'}", "--perceptual=none")
    assert done.exit_code == 3 and "every figure is undefined on these pictures" in done.stderr
    assert "3 masks with nothing brighter than half of white" in done.stderr


def test_a_mask_leaves_out_what_is_black_and_divides_by_the_rest(data):
    folder, arrays = data
    inside = np.zeros((40, 48), np.uint8)
    inside[10:20, 5:30] = 255
    write(folder / "masks" / "view1.png", inside)
    write(folder / "masks" / "view2.png", np.dstack([inside] * 3))
    done = pixels(folder, f"--mask={folder / 'masks'}", "--perceptual=none")
    assert done.exit_code == 0, done.output
    assert "1 of --renders without one in --mask: view10" in done.stderr
    views = saved(folder)["metrics"]["edit.psnr_mean"]["views"]
    for v in ("view1", "view2"):
        a, b = (arrays[g][v][10:20, 5:30].astype(np.float64) / 255 for g in ("edited", "renders"))
        assert views[v] == pytest.approx(-10 * math.log10(((a - b) ** 2).mean()), abs=1e-4)
    assert list(views) == ["view1", "view2"]


@pytest.mark.parametrize("background", ["black", "white"])
def test_transparent_parts_of_a_mask_do_not_count_over_any_background(data, background):
    folder, arrays = data
    cut_out = np.full((40, 48, 4), 255, np.uint8)
    cut_out[..., 3] = 0
    cut_out[10:20, 5:30, 3] = 255
    write(folder / "masks" / "view1.png", cut_out)
    done = pixels(
        folder, f"--mask={folder / 'masks'}", f"--background={background}", "--perceptual=none"
    )
    assert done.exit_code == 0, done.output
    views = saved(folder)["metrics"]["edit.psnr_mean"]["views"]
    a, b = (arrays[g]["view1"][10:20, 5:30].astype(float) / 255 for g in ("edited", "renders"))
    assert views == {"view1": pytest.approx(-10 * math.log10(((a - b) ** 2).mean()), abs=1e-4)}


def test_a_mask_acts_on_the_perceptual_distance_too(data, models):
    folder, arrays = data
    inside = np.zeros((40, 48), np.uint8)
    inside[:, 16:] = 255
    for view, mask in zip(
        VIEWS, (inside, np.full_like(inside, 255), np.zeros_like(inside)), strict=True
    ):
        write(folder / "masks" / f"{view}.png", mask)
    done = everything(folder, models, f"--mask={folder / 'masks'}")
    assert done.exit_code == 0, done.output
    row = saved(folder)["metrics"]["perceptual.distance"]
    encoder = load_encoder(models["perceptual"], "perceptual")
    edited, renders = (
        [arrays[g][v].astype(np.float32) / 255 for v in VIEWS] for g in ("edited", "renders")
    )
    put = np.concatenate([renders[0][:, :16], edited[0][:, 16:]], axis=1)
    part, whole = (
        1.5 * encoder.distance([put], renders[:1])[0],
        encoder.distance(edited[1:2], renders[1:2])[0],
    )
    assert row["views"] == {
        "view1": pytest.approx(part),
        "view2": pytest.approx(whole),
        "view10": None,
    }
    assert row["value"] == pytest.approx((part + whole) / 2)
    assert (row["n"], row["undefined"]) == (2, ["view10"])
    assert "1 mask with nothing brighter than half of white" in done.stderr


@pytest.mark.door
@pytest.mark.parametrize(
    "spoil, complaint",
    [
        (
            lambda f: cut(f / "renders" / "view2.png"),
            r"view2\.png: the picture is damaged \(image file is truncated",
        ),
        (
            lambda f: write(f / "renders" / "view2.jpg", np.zeros((40, 48, 3), np.uint8)),
            r"have one name; pictures are",
        ),
    ],
)
def test_a_bad_picture_is_wrong_input_and_is_named(data, models, spoil, complaint):
    folder, _ = data
    spoil(folder)
    done = everything(folder, models)
    assert done.exit_code == 2 and re.search(complaint, done.stderr), done.output
    assert len(done.stderr.strip().splitlines()) == 1 and not list(
        (folder / "out").glob("metrics.*")
    )


def cut(path):
    path.write_bytes(path.read_bytes()[:-900])


@pytest.mark.parametrize("turn", [2, 3, 6, 7, 8])
def test_a_picture_is_measured_as_viewers_turn_it(tmp_path, turn):
    """Oracle: the PSNR of what Pillow's own turning gives, by hand."""
    random = np.random.default_rng(turn)
    stored = random_picture(random)
    tags = Image.Exif()
    tags[0x112] = turn
    (tmp_path / "edited").mkdir()
    Image.fromarray(stored).save(tmp_path / "edited/a.png", exif=tags)
    with Image.open(tmp_path / "edited/a.png") as picture:
        shown = np.asarray(ImageOps.exif_transpose(picture))
    render = np.clip(shown + random.normal(0, 10, shown.shape), 0, 255).round().astype(np.uint8)
    write(tmp_path / "renders/a.png", render)
    result = pixels(tmp_path, "--perceptual=none")
    assert result.exit_code == 0, result.output
    note = "1 pictures are turned as their EXIF tags ask, a.png first"
    assert note in " ".join(result.output.split())
    mse = (((render / 255) - (shown / 255)) ** 2).mean()
    measured = saved(tmp_path)["metrics"]["edit.psnr_mean"]["value"]
    assert measured == pytest.approx(-10 * math.log10(mse), abs=1e-4)
    if turn >= 5:
        write(tmp_path / "renders/a.png", stored)
        refused = " ".join(pixels(tmp_path, out="two").output.split())
        assert "edited/a.png is turned as its EXIF tag asks): a pair must have" in refused


def test_other_folders_and_flags_that_will_not_do(data):
    folder, _ = data
    one = f"--renders={folder / 'renders'}"
    for arguments, complaint in (
        ((f"--renders={folder / 'nowhere'}", "--prompt=x"), "--renders: "),
        ((one, "--prompt= "), "--prompt: is empty"),
        (
            (one, "--prompt=x", "--clip=clip:/nowhere"),
            "--clip: clip:/nowhere: there is no folder /nowhere. Place these",
        ),
        ((one, "--prompt=x", "--clip=dino-small"), "is of kind 'dino', expected 'clip'"),
        # Where no figure needs it, too.
        ((one, "--clip=clap"), "--clip: encoder 'clap': unknown; did you mean"),
        (
            (one, "--prompt=x", "--background=red"),
            "--background: got 'red', expected black, white or r,g,b",
        ),
        (
            (one, "--device=gpu"),
            "device 'gpu': unknown, expected cpu or cuda",
        ),
    ):
        done = call("metrics", *arguments, "--out", folder / "out")
        assert done.exit_code == 2 and complaint in done.stderr, done.output


def test_16_bits_grey_and_transparent_pictures_are_read_as_documented(tmp_path):
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    assert np.array_equal(
        read_picture(write(tmp_path / "g.png", grey)),
        np.repeat(grey[..., None] / np.float32(255), 3, 2),
    )
    deep = np.dstack([grey.astype(np.uint16) * 257 + 5] * 3).clip(0, 65535).astype(np.uint16)
    np.testing.assert_allclose(
        read_picture(write(tmp_path / "d.png", deep)), deep / 65535, atol=1e-7
    )
    clear = np.zeros((2, 2, 4), np.uint8)
    clear[0] = (200, 100, 50, 255)
    clear[1] = (200, 100, 50, 51)  # a fifth
    path = write(tmp_path / "a.png", clear)
    for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.5, 0.7)):
        seen = read_picture(path, background)
        np.testing.assert_allclose(seen[0, 0], np.array([200, 100, 50]) / 255, atol=1e-6)
        expected = 0.2 * np.array([200, 100, 50]) / 255 + 0.8 * np.array(background)
        np.testing.assert_allclose(seen[1, 1], expected, atol=1e-6)
    assert seen.dtype == np.float32 and seen.shape == (2, 2, 3)
    assert inside(read_picture(write(tmp_path / "m.png", grey))).sum() == 128


def test_transparency_is_laid_over_the_chosen_background_before_it_is_measured(tmp_path):
    clear = np.zeros((40, 48, 4), np.uint8)
    write(tmp_path / "renders" / "a.png", clear)
    write(tmp_path / "edited" / "a.png", np.full((40, 48, 3), 255, np.uint8))
    for background, expected in (
        ("black", 0.0),
        ("white", "inf"),
        ("0.5,0.5,0.5", -20 * math.log10(0.5)),
    ):
        pixels(tmp_path, "--perceptual=none", f"--background={background}")
        value = saved(tmp_path)["metrics"]["edit.psnr_pooled"]["value"]
        assert value == (
            expected if isinstance(expected, str) else pytest.approx(expected, abs=1e-5)
        )


def test_a_long_prompt_is_cut_and_that_is_said(data, models):
    folder, _ = data
    renders, clip = f"--renders={folder / 'renders'}", f"--clip={models['clip']}"
    done = call("metrics", renders, "--prompt", "bear " * 40, clip, "--out", folder / "out")
    assert (
        done.exit_code == 0
        and "--prompt is longer than the encoder takes: its last 18 tokens" in done.stderr
    )


def test_the_encoders_are_listed_and_one_is_described(models):
    listed = call("encoders").stdout
    for name in (
        "clip-small",
        "clip-parts",
        "dino-small",
        "perceptual-small",
        "clip:FOLDER",
        "dinov2:FOLDER",
        "lpips:FILE_OR_FOLDER",
    ):
        assert name in listed
    assert "weights_sha256" in call("encoders", models["dino"]).stdout
    wrong = call("encoders", "dino:x")
    assert wrong.exit_code == 2 and "did you mean 'dinov2:FOLDER'" in wrong.stderr


def test_a_default_that_is_not_installed_costs_its_figures_but_one_that_was_named_is_an_error(
    data, monkeypatch
):
    folder, _ = data
    monkeypatch.setattr(bundled, "load", partial(bundled.load, folder=folder / "nowhere"))
    done = pixels(folder)
    assert done.exit_code == 0 and set(saved(folder)["metrics"]) == {
        "edit.psnr_mean",
        "edit.psnr_pooled",
    }
    place = folder / "nowhere" / "perceptual-small.safetensors"
    reason = f"needs --perceptual: {place}: missing; install the package again"
    assert saved(folder)["not_computed"]["Perceptual distance"].startswith(reason)
    done = pixels(folder, "--perceptual=perceptual-small")
    assert done.exit_code == 2 and f"--perceptual: {place}: missing" in done.stderr


def test_a_bundled_encoder_s_figures_come_with_a_warning(data, models, monkeypatch):
    encoder = load_encoder(models["clip"])
    encoder.about = replace(encoder.about, name="clip-small", source="bundled")
    asked = []
    monkeypatch.setattr(measure, "load_encoder", lambda *a, **k: asked.append((a, k)) or encoder)
    folder, _ = data
    done = call(
        "metrics", f"--renders={folder / 'renders'}", "--prompt=a bear", "--out", folder / "out"
    )
    assert asked == [
        (("clip-small", "clip"), {"device": "cpu"})
    ]  # the default, and nothing that no figure needs
    assert (
        done.exit_code == 0
        and "clip-small is small and was trained on random rendered scenes" in done.stderr
    )


def test_a_measurement_that_was_interrupted_goes_on_and_ends_as_one_that_was_not(
    tmp_path, models, monkeypatch
):
    random = np.random.default_rng(8)
    names = [f"v{k}" for k in range(BATCH + 2)]
    for name in names:
        for group in ("renders", "edited"):
            write(tmp_path / group / f"{name}.png", random_picture(random))
    write(tmp_path / "edited" / "v1.png", cv2.imread(str(tmp_path / "renders/v1.png"))[..., ::-1])
    real, read = measure.read_picture, []

    def reading(path, *more):
        read.append(path.stem)
        if path.stem == names[-1] and read.count(path.stem) == 1:
            raise KeyboardInterrupt
        return real(path, *more)

    monkeypatch.setattr(measure, "read_picture", reading)

    def run(out):
        read_before = len(read)
        folders = [f"--{group}={tmp_path / group}" for group in ("renders", "edited")]
        encoders = [f"--clip={models['clip']}", "--perceptual=none", "--prompt=a bear"]
        command = ["metrics", *folders, *encoders, "--out", str(tmp_path / out)]
        return CliRunner().invoke(app, command), set(read[read_before:])

    killed, _ = run("a")
    assert killed.exit_code == 130 and "finished batches of views are kept" in killed.stderr
    done, views = run("a")
    assert done.exit_code == 0, done.output
    assert views == set(names[BATCH:])
    _, views = run("b")
    assert views == set(names)
    files = ("metrics.json", "metrics.md", "metrics.html")
    expected = [(tmp_path / "b" / file).read_bytes() for file in files]
    assert [(tmp_path / "a" / file).read_bytes() for file in files] == expected
    values = json.loads((tmp_path / "a" / "metrics.json").read_text())["metrics"]
    assert values["edit.psnr_mean"]["identical"] == ["v1"]
    # Another picture of the same name is another cell.
    write(tmp_path / "renders" / "v0.png", random_picture(random))
    changed, views = run("a")
    assert changed.exit_code == 0 and views == set(names[:BATCH])


def test_normals_and_depth_that_render_writes_are_no_views(tmp_path):
    import attnwarp.cli.main
    from attnwarp.camera import Camera
    from attnwarp.fit import from_points
    from attnwarp.io import Dataset, write_ply, write_transforms

    random = np.random.default_rng(0)
    points = random.uniform(-1, 1, (50, 3))
    colors = random.integers(0, 256, (50, 3), dtype=np.uint8)
    write_ply(tmp_path / "splats.ply", from_points(points, colors, kind="2d", sh_degree=0, seed=0))
    cameras = [
        Camera.look_at((4 * x, 3, 1), (0, 0, 0), width=24, height=16, fov_y=40, name=name)
        for x, name in ((-1, "left"), (1, "right"))
    ]
    (tmp_path / "cameras").mkdir()
    write_transforms(tmp_path / "cameras", Dataset(cameras, [None] * 2))
    for out, more in (("renders", ["--normal", "--depth"]), ("edited", ["--background", "white"])):
        arguments = [tmp_path / "splats.ply", tmp_path / "cameras", "--out", tmp_path / out, *more]
        done = CliRunner().invoke(attnwarp.cli.main.app, ["render", *map(str, arguments)])
        assert done.exit_code == 0, done.output
    assert (tmp_path / "renders" / "left.normal.png").is_file()
    # A map without its picture is a view like any other.
    write(tmp_path / "renders" / "alone.normal.png", random_picture(random, (16, 24)))
    done = pixels(tmp_path, "--perceptual=none")
    assert done.exit_code == 0, done.output
    result = saved(tmp_path)
    views = result["metrics"]["edit.psnr_mean"]["views"]
    assert list(views) == ["left", "right"]
    for view, value in views.items():
        one, other = (
            cv2.imread(str(tmp_path / name / f"{view}.png")) / 255 for name in ("renders", "edited")
        )
        assert value == pytest.approx(-10 * math.log10(((one - other) ** 2).mean()), abs=1e-4)
    assert "2 normal maps beside pictures" in done.stderr and "left.normal.png" in done.stderr
    assert "alone.normal" in done.stderr
