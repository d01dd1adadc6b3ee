"""The one place that imports pycolmap: a program of its own, ``python -m attnwarp_eval._colmap
FOLDER``.

In one process with other packages pycolmap corrupts memory: its compression library takes the place
of theirs.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

SEED = 0
"""Seed of RANSAC; with one thread the same pictures give the same reconstruction."""


def summary(reconstruction: Any) -> dict[str, float]:
    """Figures of a ``pycolmap.Reconstruction``."""
    return {
        "registered": reconstruction.num_reg_images(),
        "points": reconstruction.num_points3D(),
        "track_length": reconstruction.compute_mean_track_length(),
        "reprojection_error": reconstruction.compute_mean_reprojection_error(),
    }


def main(folder: Path) -> None:
    """Reconstruct the pictures of ``folder`` and write ``result.json`` there.

    ``pictures.npz`` has (H, W, 3) uint8 arrays; ``cameras.json`` has for each intrinsics the names
    of the arrays that share them: [[fx, fy, cx, cy], names].
    """
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    images, database = folder / "images", folder / "database.db"
    images.mkdir()
    with np.load(folder / "pictures.npz") as pictures:
        for name in pictures.files:
            pycolmap.Bitmap.from_array(pictures[name]).write(images / f"{name}.png")
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    for intrinsics, names in json.loads((folder / "cameras.json").read_text()):
        pycolmap.extract_features(
            database,
            images,
            image_names=[f"{name}.png" for name in names],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(
                camera_model="PINHOLE", camera_params=",".join(map(str, intrinsics))
            ),
            extraction_options=extraction,
        )
    pycolmap.match_exhaustive(
        database, matching_options=pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=1)
    )
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=SEED, ba_refine_focal_length=False, ba_refine_extra_params=False
    )
    found = pycolmap.incremental_mapping(database, images, folder / "models", options)
    largest = max(found.values(), key=lambda one: one.num_reg_images(), default=None)
    (folder / "result.json").write_text(json.dumps(None if largest is None else summary(largest)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
