"""NumPy or torch, alike: public functions give the same for arrays of either library."""

import numpy as np
import pytest
import torch

from attnwarp import Camera, Gaussians, losses, warp
from attnwarp.fit import Views
from attnwarp.render import normal_from_depth, render

RANDOM = np.random.default_rng(0)
K = np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]])
CAMERA = Camera(K, np.eye(4), 16, 16)
IMAGE, OTHER = RANDOM.random((2, 16, 16, 3))
DEPTH = np.full((16, 16), 2.0)
NORMAL = np.tile([0.0, 0.0, -1.0], (16, 16, 1))
SPLATS = (
    np.array([[0.0, 0, 2]]), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)), np.ones(1), np.ones((1, 1, 3)),
)  # fmt: skip
MODEL = Gaussians("3d", *map(torch.from_numpy, SPLATS))
WALL = warp.correspond(CAMERA, CAMERA, DEPTH)
LAYER = warp.warp_surfaces(
    CAMERA, CAMERA, warp.Surface(DEPTH, NORMAL), warp.Surface(DEPTH, NORMAL)
).at((4, 4))
TOKENS = RANDOM.random((1, 16, 4))

CALLS = {
    "Camera": (lambda k, e: Camera(k, e, 16, 16).position, K, np.eye(4)),
    "Camera.project": (lambda x: CAMERA.project(x)[0], np.ones((2, 3))),
    "Camera.unproject": (CAMERA.unproject, np.ones((2, 2)), np.ones(2)),
    "Gaussians": (lambda *arrays: Gaussians("3d", *arrays).means, *SPLATS),
    "Gaussians.sh_from_rgb": (Gaussians.sh_from_rgb, np.ones((1, 3))),
    "Gaussians.select": (lambda k: MODEL.select(k).means, np.array([0])),
    "Views": (lambda x: Views([CAMERA], [x]).target(0, torch.zeros(3)), IMAGE),
    "Views.target": (lambda b: Views([CAMERA], [IMAGE]).target(0, b), np.zeros(3)),
    "render(background)": (lambda b: render(MODEL, CAMERA, background=b).color, np.ones(3)),
    "render(features)": (lambda f: render(MODEL, CAMERA, features=f).color, np.ones((1, 4))),
    "render(pose)": (lambda p: render(MODEL, CAMERA, pose=p).color, np.eye(4)),
    "normal_from_depth": (lambda d: normal_from_depth(d, CAMERA), DEPTH),
    "losses.l1": (losses.l1, IMAGE, OTHER),
    "losses.psnr": (losses.psnr, IMAGE, OTHER),
    "losses.ssim": (losses.ssim, IMAGE, OTHER),
    "losses.ssim_map": (losses.ssim_map, IMAGE, OTHER),
    "losses.ssim_terms": (lambda a, b: losses.ssim_terms(a, b)[0], IMAGE, OTHER),
    "correspond": (lambda d: warp.correspond(CAMERA, CAMERA, d).xy, DEPTH),
    "sample": (lambda f: warp.sample(f, WALL)[0], IMAGE.transpose(2, 0, 1)),
    "sample_at": (warp.sample_at, IMAGE.transpose(2, 0, 1), np.ones((4, 4, 2))),
    "sample_depth": (lambda d: warp.sample_depth(d, WALL), DEPTH),
    "resize_mask": (lambda m: warp.resize_mask(m, (4, 4)), DEPTH > 0),
    "resize_depth": (lambda d: warp.resize_depth(d, (4, 4)), DEPTH),
    "angle_between": (warp.angle_between, NORMAL, NORMAL[::-1]),
    "facing": (lambda n: warp.facing(WALL, n), NORMAL),
    "depth_agrees": (lambda d: warp.depth_agrees(WALL, d), DEPTH),
    "photometric": (lambda a, b: warp.photometric(WALL, a, b), IMAGE, OTHER),
    "FeatureWarp.warp": (LAYER.warp, RANDOM.random((3, 4, 4))),
    "FeatureWarp.warp_tokens": (LAYER.warp_tokens, TOKENS),
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_arrays_of_either_library_give_the_same(name):
    call, *arrays = CALLS[name]
    tensors = [torch.from_numpy(array.copy()) for array in arrays]
    ours, theirs = call(*arrays), call(*tensors)
    np.testing.assert_array_equal(np.asarray(ours), np.asarray(theirs))
