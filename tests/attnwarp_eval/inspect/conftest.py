import pytest
from torch_threads import on_one_thread

from attnwarp_eval.inspect import subject
from attnwarp_eval.truth.mitsuba import build


@pytest.fixture(autouse=True, scope="package")
def few_texels():
    """Textures for pictures of 64, not 512 rows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "TEXELS", 256)
        yield
        build.forget()


@pytest.fixture(scope="package")
def chosen(few_texels):
    return subject.of_scene("spheres", 64)


@pytest.fixture(scope="package")
def pair(chosen):
    return chosen.pair("corrected", "yaw060")


one_thread = pytest.fixture(on_one_thread, autouse=True, scope="package")


@pytest.fixture(scope="package")
def folders(tmp_path_factory, one_thread):
    """A user's scene: splats, a data set with pictures, and the folder of an edit of them."""
    from dataclasses import replace

    import numpy as np
    from tiny_editors import pix2pix
    from tiny_scenes import cameras, pictures, splats

    from attnwarp.editing.editors.pix2pix import InstructPix2Pix
    from attnwarp.io import Dataset, write_ply, write_transforms
    from attnwarp.io.images import encode_png
    from attnwarp.methods import attention_warping, preset

    folder = tmp_path_factory.mktemp("own")
    model = splats()
    views = [replace(camera, name=f"images/{k}.png") for k, camera in enumerate(cameras())]
    images = pictures(model, views)
    (folder / "images").mkdir()
    for camera, image in zip(views, images, strict=True):
        (folder / camera.name).write_bytes(
            encode_png(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8))
        )
    write_ply(folder / "scene.ply", model)
    write_transforms(
        folder / "transforms.json", Dataset(views, [folder / camera.name for camera in views])
    )
    settings = preset("attention_warping", stages=2, views_per_stage=1, steps=1, iterations=0)
    pipe = pix2pix()
    editor = InstructPix2Pix(
        pipe.unet, pipe.vae, pipe.text_encoder, pipe.tokenizer, pipe.scheduler, text_guidance=3.0
    )
    attention_warping(model, views, images, editor, "red", settings, folder=folder / "edit")
    return folder
