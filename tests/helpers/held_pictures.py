"""Number of pictures that a run keeps while it tunes on them."""

import weakref

from attnwarp.methods.pictures import full_size


def watch(monkeypatch, module, held_bytes):
    """Watch the pictures that a module's runs make, with so much memory to keep them in.

    Returns:
        For each picture in the order they were made, how many were held then, itself included.
    """
    references, counts = [], []

    def watched(*args):
        picture = full_size(*args)
        references.append(weakref.ref(picture))
        counts.append(sum(one() is not None for one in references))
        return picture

    monkeypatch.setattr(module, "full_size", watched)
    monkeypatch.setattr(module, "HELD_BYTES", held_bytes)
    return counts
