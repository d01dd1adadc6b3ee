"""Oracle: the angles that the names say."""

import json
from pathlib import Path

import pytest

from attnwarp.errors import InputError
from attnwarp_lab.userstudy.material import Item, read_items


def test_a_turntable_turns_one_way_also_where_yaws_are_negative():
    in_order = ["yawm120", "yawm30", "yawm7p5", "source", "yaw010", "yaw090", "yaw180"]
    files = {view: Path(view) for view in sorted(in_order)}
    item = Item("bear", "red", 0, "make it red", files, {"a": files, "b": files})
    assert item.views == in_order


def test_views_of_other_names_stay_in_the_order_of_their_names():
    files = {view: Path(view) for view in ("c_2", "a", "b-10")}
    item = Item("own", "red", 0, "make it red", files, {"a": files})
    assert item.views == ["a", "b-10", "c_2"]


@pytest.mark.parametrize("place", ["folder", "originals"])
def test_a_captures_pictures_lie_in_its_folder(tmp_path, place):
    cells = [
        {"id": name, "scene": "bear", "edit": "red", "seed": 0, "variants": [name],
         "folder": f"made/{name}"}
        for name in ("a", "b")
    ]  # fmt: skip
    bear = {"sha256": "0", "views": ["front"], "originals": "bear", "edits": {"red": "red"}}
    data = {"captures": {"bear": bear}, "cells": cells}

    def read():
        (tmp_path / "results.json").write_text(json.dumps(data))
        return read_items(tmp_path)

    (item,) = read()
    assert item.methods["b"] == {"view-0000": tmp_path / "made/b/renders/view-0000.png"}
    (cells[0] if place == "folder" else bear)[place] = "../elsewhere"
    with pytest.raises(InputError, match="leads out of"):
        read()
