"""Oracle: the angles that the names say."""

from pathlib import Path

from attnwarp_eval.userstudy.material import Item


def test_a_turntable_turns_one_way_also_where_yaws_are_negative():
    in_order = ["yawm120", "yawm30", "yawm7p5", "source", "yaw010", "yaw090", "yaw180"]
    files = {view: Path(view) for view in sorted(in_order)}
    item = Item("bear", "red", 0, "make it red", (), files, {"a": files, "b": files})
    assert item.views == in_order


def test_views_of_other_names_stay_in_the_order_of_their_names():
    files = {view: Path(view) for view in ("c_2", "a", "b-10")}
    item = Item("own", "red", 0, "make it red", (), files, {"a": files})
    assert item.views == ["a", "b-10", "c_2"]
