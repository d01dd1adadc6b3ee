"""Editing: attention features recorded and injected, editors over diffusers' models, inversions.

The parts are separate modules, so that those that need diffusers (the extra ``edit``) are imported
only on use. Each editor is a file in ``editors``.
"""
