"""Editing: attention features recorded and injected, editors over diffusers' models, inversions.

The parts are modules of their own, so that what needs diffusers (the extra ``edit``) is imported
only where it is used. An editor is a file in ``editors``.
"""
