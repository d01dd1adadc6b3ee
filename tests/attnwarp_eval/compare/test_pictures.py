"""Pictures beside a baseline. Oracle: the files that were written."""

import pathlib

import pytest

from attnwarp.errors import InputError
from attnwarp_eval.compare import Snapshot
from attnwarp_eval.compare import pictures as module
from attnwarp_eval.compare.pictures import folder_of, pictures_of_baseline, write_pictures
from attnwarp_eval.compare.snapshot import Figure, Measured


def written(tmp_path, *views, text):
    """Pictures of one cell as a run has them."""
    table = {}
    for number, view in enumerate(views):
        path = tmp_path / f"{text}-{number}.jpg"
        path.write_text(f"{text} {view}")
        table["d", 0, view] = {"mask": path}
    return table


def read(baseline, *views):
    figures = {"warp.epe_median": Figure(1, dict.fromkeys(views, 0.5))}
    cell = Measured("bear", "warp", ("a",), 0, "d", {}, figures)
    table = pictures_of_baseline(baseline, Snapshot("my", "", (cell,)))
    return {view: files["mask"].read_text() for (_, _, view), files in table.items()}


def test_views_are_found_again_whatever_their_names(tmp_path):
    views = ("front__left", "some_edit/yaw030", "some_edit=red/front__left", "yaw060")
    baseline = tmp_path / "base.jsonl"
    write_pictures(baseline, written(tmp_path, *views, text="of"))
    assert read(baseline, *views, "unpictured") == {view: f"of {view}" for view in views}


def test_no_picture_leads_out_of_the_baselines_folder(tmp_path):
    """A baseline or a run may come from elsewhere."""
    baseline = tmp_path / "gate.jsonl"
    (key, files), *_ = written(tmp_path, "a", text="new").items()
    with pytest.raises(InputError, match="leads out of"):
        write_pictures(baseline, {key: {"../../../evil": files["mask"]}})
    with pytest.raises(InputError, match="leads out of"):
        write_pictures(baseline, {("../../evil", *key[1:]): files})
    assert not list(tmp_path.glob("evil*")) + list(tmp_path.parent.glob("evil*"))


def test_former_pictures_stay_until_all_of_the_new_ones_are_there(tmp_path, monkeypatch):
    baseline, views = tmp_path / "base.jsonl", ("yaw030", "yaw060")
    write_pictures(baseline, written(tmp_path, *views, text="former"))
    new = written(tmp_path, *views, text="new")

    def killed(path: pathlib.Path, data: bytes) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(module, "write_atomic", killed)
        write_pictures(baseline, new)
    assert read(baseline, *views) == {view: f"former {view}" for view in views}
    write_pictures(baseline, new)
    assert read(baseline, *views) == {view: f"new {view}" for view in views}
    write_pictures(baseline, written(tmp_path, "yaw060", text="last"))
    assert read(baseline, *views) == {"yaw060": "last yaw060"}
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == [folder_of(baseline)]
    write_pictures(baseline, {})
    assert not folder_of(baseline).exists()
