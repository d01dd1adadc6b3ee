"""Attention warping with editors of joint attention: references, sets of blocks, kills."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_joint as tiny
from edit_folders import Killed, Watched, events, files
from tiny_scenes import cameras, pictures, splats

import attnwarp
from attnwarp.methods import attention_warping, preset


@pytest.fixture(scope="module")
def scene():
    return splats(), cameras(3, size=16)


def edited(scene, name, folder=None, report=None, **changes):
    settings = preset("attention_warping", **{"stages": 1, "steps": 2, "iterations": 0, **changes})
    more = {} if report is None else {"report": report, "checkpoint_seconds": 0}
    editor = tiny.editor(name, **({"text_guidance": 1.0} if name == "klein" else {}))
    return attention_warping(*scene, None, editor, "red", settings, folder=folder, **more)


@pytest.mark.parametrize("kinds", [None, ["key", "value"]], ids=["outputs", "keys"])
def test_a_source_is_its_own_edit_and_targets_take_features_of_named_blocks(scene, kinds):
    alone = edited(scene, "kontext", a0=0.0)
    whole = edited(scene, "kontext", kinds=kinds)
    single = edited(scene, "kontext", kinds=kinds, blocks=["single"])
    assert (whole.edited[0] == alone.edited[0]).all()
    assert (whole.edited[1] != alone.edited[1]).any()
    assert (single.edited[1] != whole.edited[1]).any()
    assert whole.counters["injected"] > 0.1
    assert 2 * single.counters["feature_bytes"] == whole.counters["feature_bytes"]
    # 8 x 8 tokens of 32 channels, 4 blocks, 2 steps, 1 branch, float32; keys and values are two.
    assert whole.counters["feature_bytes"] == 8 * 8 * 32 * 4 * 2 * 4 * (1 if kinds is None else 2)
    with pytest.raises(ValueError, match="blocks: got 'freeflux', expected one of 'all', 'double'"):
        edited(scene, "kontext", blocks=["freeflux"])


def test_the_sources_edit_is_a_second_reference_plain_or_warped(scene):
    """Oracle: the targets edited by hand, with pictures stacked here."""
    from attnwarp.editing.editor import edit, shared_noise

    alone = edited(scene, "klein", a0=0.0)
    plain = edited(scene, "klein", a0=0.0, reference="plain")
    warped = edited(scene, "klein", a0=0.0, reference="warped")
    assert (plain.edited[0] == alone.edited[0]).all()
    assert (warped.edited[1] != plain.edited[1]).any()
    before, editor = pictures(*scene), tiny.editor("klein", text_guidance=1.0)
    noise = shared_noise((1, *editor.noise_shape((16, 16))), 0)
    first = edit(editor, before[:1], "red", steps=2, noise=noise).images[0]
    for view in (1, 2):
        pair = np.stack([before[view], first])
        by_hand = edit(editor, [pair], "red", steps=2, noise=noise).images[0]
        # Batches of two views sum in another order.
        assert np.abs(np.rint(255 * by_hand) - plain.edited[view]).max() <= 1
    with pytest.raises(ValueError, match=r"reference: got 'plain', but .* sees one picture alone"):
        edited(scene, "kontext", reference="plain")
    both = edited(scene, "klein", reference="warped")
    assert (both.edited[1] != warped.edited[1]).any()


def test_a_killed_edit_goes_on_to_the_same_bytes(scene, tmp_path):
    changes = {"reference": "warped", "iterations": 2}
    edited(scene, "klein", tmp_path / "whole", **changes)
    # Two steps of Adam are as small as its learning rates.
    advice = json.loads((tmp_path / "whole" / "result.json").read_text())["advice"]
    assert advice.startswith("the splats hardly took the edit: try more --iterations")
    for moment in (3, 9):  # in the source's edit, and after it
        folder = tmp_path / str(moment)
        with pytest.MonkeyPatch.context() as patch:
            watch, _ = events(patch, moment)
            with pytest.raises(Killed):
                edited(scene, "klein", folder, Watched(watch), **changes)
        edited(scene, "klein", folder, **changes)
        assert files(folder) == files(tmp_path / "whole")


WITHOUT = """
import json, sys
from pathlib import Path
import tiny_joint as tiny
from attnwarp.editing.editor import edit
from attnwarp.editing.editors import __file__ as home, kinds
from attnwarp.editing.small import load_editor
from attnwarp.errors import InputError

assert Path(home).is_relative_to(Path.cwd())
left = [name for name in tiny.NAMES if tiny.PIPELINES[name] in kinds()]
print(*left)
for name in left:
    edit(tiny.editor(name), [tiny.picture(name, 3, 2)], "red", steps=1)
for name in set(tiny.NAMES) - set(left):
    Path(name).mkdir()
    index = {"_class_name": tiny.PIPELINES[name]}
    (Path(name) / "model_index.json").write_text(json.dumps(index))
    try:
        load_editor(name)
    except InputError as error:
        assert tiny.PIPELINES[name] in str(error) and tiny.PIPELINES[left[0]] in str(error)
    else:
        raise AssertionError(name)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "gone"),
    [
        ("qwen_image_edit", {"qwen", "qwen-plus"}),
        ("flux2_klein", {"klein"}),
        ("flux_kontext", {"kontext"}),
        ("stable_diffusion3", {"sd3"}),
    ],
)
def test_without_the_file_of_an_editor_the_others_edit(file, gone, tmp_path):
    shutil.copytree(Path(attnwarp.__file__).parent, tmp_path / "attnwarp", copy_function=os.link)
    (tmp_path / f"attnwarp/editing/editors/{file}.py").unlink()
    paths = [tmp_path, Path(tiny.__file__).parent]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert set(tiny.NAMES) - set(done.stdout.split()) == gone


def test_no_module_but_an_editors_own_names_an_architecture():
    """So that an editor can be taken away, or added, as one file."""
    home = Path(attnwarp.__file__).parent
    named = re.compile(r"flux|klein|kontext|qwen|sd3|stable.?diffusion.?3", re.IGNORECASE)
    for place in ("methods", "editing"):
        for path in (home / place).rglob("*.py"):
            if path.parent.name != "editors":
                assert not named.search(path.read_text(encoding="utf-8")), path
