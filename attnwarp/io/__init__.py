"""Files: splats as PLY and .splat, cameras as transforms.json, COLMAP models and BlendedMVS."""

from attnwarp.io.blendedmvs import read_blendedmvs
from attnwarp.io.colmap import read_colmap
from attnwarp.io.dataset import Dataset
from attnwarp.io.file import FileFormatError
from attnwarp.io.folder import read_dataset
from attnwarp.io.images import image_size, read_image, read_upright
from attnwarp.io.lens import Lens, undistorted_camera, undistorted_image
from attnwarp.io.ply import THIRD_SCALE, read_ply, read_points, write_ply, write_points
from attnwarp.io.splat import read_splat, write_splat
from attnwarp.io.transforms import read_transforms, write_transforms
from attnwarp.io.undistortion import undistort

__all__ = [
    "THIRD_SCALE",
    "Dataset",
    "FileFormatError",
    "Lens",
    "image_size",
    "read_blendedmvs",
    "read_colmap",
    "read_dataset",
    "read_image",
    "read_ply",
    "read_points",
    "read_splat",
    "read_transforms",
    "read_upright",
    "undistort",
    "undistorted_camera",
    "undistorted_image",
    "write_ply",
    "write_points",
    "write_splat",
    "write_transforms",
]
