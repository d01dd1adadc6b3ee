"""torch on one thread: small tensors gain nothing from more, and lose much where others want the cores.

A test file makes a fixture of it, of the scope that it needs. ::

    one_thread = pytest.fixture(on_one_thread, scope="module", autouse=True)
"""

import torch


def on_one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
