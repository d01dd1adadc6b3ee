"""A bench for methods that live elsewhere: scenes as files, scores of pictures, tables."""

EDITORS: dict[str, str] = {}
"""Editors that are made from the truth, by name: "module:function" of the views before the edit,
the truth, and the number of steps. The laboratory adds the ideal one.
"""
