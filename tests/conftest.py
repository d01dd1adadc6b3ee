import pytest


@pytest.fixture(autouse=True, scope="session")
def cache_of_this_run(tmp_path_factory):
    """Derived files go to a folder of their own, so that no test is passed by what an earlier run
    left behind.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ATTNWARP_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
