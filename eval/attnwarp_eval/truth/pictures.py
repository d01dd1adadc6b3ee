"""Pictures of a scene by the plan of its file, cached on disk."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from attnwarp.camera import Camera
from attnwarp_eval.cache import content_key, read_arrays, write_arrays
from attnwarp_eval.scene.scene import Scene
from attnwarp_eval.truth.llvm import variant
from attnwarp_eval.truth.mitsuba import APPEARANCE_PROTOCOL, build, render_plan
from attnwarp_eval.truth.mitsuba.build import texel_size
from attnwarp_eval.truth.plan import plan

Image = npt.NDArray[np.float32]


def appearance(scene: Scene, camera: Camera, spp: int | None = None, seed: int = 0) -> Image:
    """Render the view of ``camera``, in linear RGB.

    Args:
        camera: square pixels and no skew; any principal point.
        spp: samples a pixel; by default the scene's number.
        seed: the same seed gives the same bits.

    Returns:
        (H, W, 3) float32, not clipped; the sky on a miss. Box-filtered over each pixel.
        Cached on disk, see :mod:`attnwarp_eval.cache`.

    Raises:
        ValueError: a camera that Mitsuba cannot express.

    Example:
        >>> from attnwarp_eval.scene.file import load_scene
        >>> from attnwarp_eval.truth import appearance
        >>> scene = load_scene("spheres").with_size(8, 8)
        >>> image = appearance(scene, scene.source, spp=1)
        >>> image.shape, image.dtype, bool((image >= 0).all())
        ((8, 8, 3), dtype('float32'), True)
    """
    import mitsuba

    planned = plan(scene, spp)
    pose = {name: value for name, value in camera.to_dict().items() if name != "name"}
    key = content_key(
        "appearance",
        APPEARANCE_PROTOCOL,
        mitsuba.__version__,
        variant(),
        scene.world_hash,
        texel_size(scene),
        build.TEXELS,
        # The lens's focus and the fog's box depend on the cameras.
        (
            scene.spec.cameras.model_dump(mode="json", exclude={"size"})
            if planned.lens or planned.media
            else None
        ),
        pose,
        planned.identity(),
        int(seed),
    )
    stored = read_arrays("appearance", key)
    if stored is None:
        stored = {"image": render_plan(scene, camera, planned, seed)}
        write_arrays("appearance", key, stored)
    return stored["image"]
