import pytest
import yaml
from ball_scene import SCENE


@pytest.fixture(scope="module")
def folder(tmp_path_factory, coarse_textures):
    """A folder with the scene of a ball that has three edits."""
    path = tmp_path_factory.mktemp("study")
    (path / "ball.yaml").write_text(yaml.safe_dump(SCENE))
    return path
