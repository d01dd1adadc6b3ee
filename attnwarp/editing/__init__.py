"""Editing: attention features recorded and injected, editors over diffusers' models, inversions.

The parts are modules of their own, so that what needs diffusers (the extra ``edit``) is imported
only where it is used: ``attention``, ``editor``, ``pix2pix``, ``controlnet``, ``inversion``,
``small``.
"""
