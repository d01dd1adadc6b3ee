import pytest


@pytest.fixture(scope="module")
def coarse_textures():
    """Textures baked for pictures of 160, not 512 rows, which takes a tenth of the time."""
    from attnwarp_eval.truth.mitsuba import build

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "TEXELS", 640)
        build.forget()
        yield
        build.forget()
