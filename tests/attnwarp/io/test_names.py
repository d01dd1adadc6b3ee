"""Oracle: the names written out."""

import pytest

from attnwarp import Camera
from attnwarp.io.names import file_stems


@pytest.mark.parametrize(
    ("names", "stems"),
    [
        (["a/1.png", "b/2.png", ""], ["1", "2", "view"]),
        (["a/x.png", "b/x.png", "c/y.png"], ["0000-x", "0001-x", "y"]),
        (["a/x.png", "b/x.png", "0000-x.png"], ["0000-0000-x", "0001-x", "0000-x"]),
        (["a/x", "b/x", "0001-0001-x", "0001-x"], ["0000-x", "0001-0001-0001-x", "0001-0001-x", "0001-x"]),
    ],
)  # fmt: skip
def test_no_two_views_share_a_name_and_unique_names_stay(names, stems):
    view = {"width": 8, "height": 6, "fov_y": 40}
    cameras = [Camera.look_at((3, 0, 0), (0, 0, 0), name=name, **view) for name in names]
    assert file_stems(cameras) == stems
