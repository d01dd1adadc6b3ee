"""The working folder of a user: splats, a capture of eight views with points, and pictures."""

import cv2
import numpy as np
from few_splats import few_splats

from attnwarp import Camera
from attnwarp.io import Dataset, write_ply, write_transforms
from attnwarp.render import render

NAMES = ("my_capture", "my-capture", "DATA", "capture")
"""Names of the capture in documents; each is the folder itself."""


def write(folder):
    """Write the files into a folder that is there."""
    splats = few_splats()
    (folder / "fits/mine").mkdir(parents=True)
    for name in ("scene.ply", "point_cloud.ply", "fits/mine/splats.ply"):
        write_ply(folder / name, splats)
    cameras, paths = [], []
    for index, angle in enumerate(np.linspace(-0.5, 0.5, 8)):
        camera = Camera.look_at(
            [3 * np.sin(angle), -3 * np.cos(angle), 0.5], [0, 0, 0], width=64, height=48, fov_y=40
        )
        path = folder / "images" / f"{index}.png"
        path.parent.mkdir(exist_ok=True)
        picture = render(splats, camera).color.clamp(0, 1).numpy()
        cv2.imwrite(str(path), np.round(255 * picture[..., ::-1]).astype(np.uint8))
        cameras.append(camera)
        paths.append(path)
    colors = np.full((60, 3), 128, np.uint8)
    data = Dataset(cameras, paths, points=splats.means.numpy(), colors=colors)
    write_transforms(folder / "transforms.json", data)
    for name in NAMES:
        (folder / name).symlink_to(folder, target_is_directory=True)
