"""The scenes that come with the package: that each one holds what it claims, and stays what it was."""

import pytest

from attnwarp_eval.scene import load_scene

# Reference results name these scenes by their content, so a change of the format must leave it alone.
CONTENT = {
    "bear": "8b3c414061f18e6c6612e56794b3e5764f890a4b9dd393fb84eab878f1bc4d45",
    "fence": "27d870bed7391a4fedef54712586295bd5c0d4ef2ae7bd1d221e71f336cc7ca2",
    "spheres": "0ef637ca87740f94ad3456a6a7d586d8e38391343b8044b5b06d169c28b5f0b5",
}


@pytest.mark.parametrize("name", sorted(CONTENT))
def test_the_scenes_of_the_reference_results_are_still_the_same_content(name):
    assert load_scene(name).content_hash == CONTENT[name]
