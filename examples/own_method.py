"""Change Algorithm 1: views nearest to the source are edited first, not views at random.

python examples/own_method.py CAPTURE "make it red"
"""

import sys
from functools import partial

import numpy as np

from attnwarp.editing.small import load_editor
from attnwarp.fit import FitSettings, first_splats, fit, load_views
from attnwarp.io import read_dataset
from attnwarp.methods import AttentionWarpingSettings, preset
from attnwarp.methods.algorithms.attention_warping import AttentionWarping
from attnwarp.methods.base import run


class NearestFirst(AttentionWarping):
    """Attention warping whose stages lead away from the source."""

    def __init__(self, work, settings, **rest):
        super().__init__(work, settings, **rest)
        cameras = work.scene.cameras
        source = cameras[self.source].position
        drawn = [view for stage in self.stages for view in stage]
        drawn.sort(key=lambda view: np.linalg.norm(cameras[view].position - source))
        order = iter(drawn)
        self.stages = [[next(order) for _ in stage] for stage in self.stages]


capture, instruction = sys.argv[1:]
dataset = read_dataset(capture)
views = load_views(dataset)
of_fit = FitSettings(iterations=200)
splats = fit(first_splats(dataset, views.cameras, of_fit), views, of_fit).gaussians
settings = preset("attention_warping", stages=2, steps=4, iterations=10)
make = partial(NearestFirst, source=0, by_hand=None, warps=None, store="cpu")
result = run(
    "nearest_first", make, AttentionWarpingSettings, splats, views.cameras, views.images,
    load_editor("small-plain"), instruction, settings,
)  # fmt: skip
print("views of each stage:", *(part.views for part in result.rounds))
