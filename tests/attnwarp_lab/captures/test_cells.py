"""Workers of a reproduction."""

import pytest

from attnwarp_eval.study.cluster import _local_client
from attnwarp_lab.captures.cells import _own_device


@pytest.mark.slow
def test_each_worker_has_a_device_of_its_own():
    """Oracle: as many devices as processes, each once."""
    with _local_client(2) as client:

        def on_each(*devices):
            places = [[worker] for worker in client.nthreads()]
            asked = [client.submit(_own_device, devices, workers=p, pure=False) for p in places]
            return sorted(client.gather(asked))

        assert on_each("cuda:0", "cuda:1") == ["cuda:0", "cuda:1"]
        assert on_each("cpu") == ["cpu", "cpu"]
    assert _own_device(["cuda:3", "cuda:4"]) == "cuda:3"  # no worker: the command itself
