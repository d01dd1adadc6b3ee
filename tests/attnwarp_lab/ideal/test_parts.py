"""Oracle: parts are the same whatever the processor's rounding, the size of the world and the order
of the views.
"""

import numpy as np
import pytest

from attnwarp_eval.scene.file import load_scene
from attnwarp_eval.truth import Geometry
from attnwarp_lab.ideal.parts import part_labels

TOWER = ("card_20mm", "card_50mm", "card_100mm", "tile_20mm", "tile_50mm", "tile_100mm")


@pytest.fixture(scope="module")
def points():
    """Surface points of flat cards and tiles: a face shares a coordinate, but for rounding."""
    scene = load_scene("stack").with_size(64, 64)
    geometry = Geometry(scene)
    ids = [scene.object_names.index(name) for name in TOWER]
    views = {}
    for camera in (scene.source, scene.camera("yaw030")):
        hits = geometry.trace(camera)
        views[camera.name] = np.where(np.isin(hits.object_id, ids)[..., None], hits.point, np.nan)
    return views


def same(first, second):
    return all(np.array_equal(first[view], second[view]) for view in first)


@pytest.mark.parametrize("seed", range(3))
def test_rounding_decides_no_part(points, seed):
    rng = np.random.default_rng(seed)
    rounded = {k: p * (1 + 4e-16 * rng.standard_normal(p.shape)) for k, p in points.items()}
    assert same(part_labels(points, 12), part_labels(rounded, 12))


def test_neither_the_worlds_size_nor_the_order_of_views_decides_a_part(points):
    larger = {view: 8 * points[view] for view in reversed(list(points))}
    assert same(part_labels(points, 12), part_labels(larger, 12))
