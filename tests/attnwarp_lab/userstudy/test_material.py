"""Oracle: the angles that the names say."""

import json
from pathlib import Path

import pytest

from attnwarp.errors import InputError
from attnwarp_lab.userstudy.material import Item, read_items


def test_a_turntable_turns_one_way_also_where_yaws_are_negative():
    in_order = ["yawm120", "yawm30", "yawm7p5", "source", "yaw010", "yaw090", "yaw180"]
    files = {view: Path(view) for view in sorted(in_order)}
    item = Item("bear", "red", 0, "make it red", (), files, {"a": files, "b": files})
    assert item.views == in_order


def test_views_of_other_names_stay_in_the_order_of_their_names():
    files = {view: Path(view) for view in ("c_2", "a", "b-10")}
    item = Item("own", "red", 0, "make it red", (), files, {"a": files})
    assert item.views == ["a", "b-10", "c_2"]


@pytest.mark.parametrize("key", ["folder", "originals"])
def test_a_captures_pictures_lie_in_its_folder(tmp_path, key):
    rows = {name: {"folder": name} for name in ("a", "b")}
    data = {"words": {"instruction": "red"}, "views": [0], "variants": rows}
    (rows["a"] if key == "folder" else data)[key] = "../elsewhere"
    (tmp_path / "run").mkdir()
    (tmp_path / "run/captured.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match="leads out of"):
        read_items([tmp_path / "run"])
    assert read_items([tmp_path / "run"], within=tmp_path)
