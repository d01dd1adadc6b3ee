"""The labels of a target pixel: what truth says, and what checks count."""

NONE, VISIBLE, HIDDEN, AMBIGUOUS = 0, 1, 2, 3
"""No surface or its point outside the source image; shown by the source; hidden from it; not the
same over the pixel.

:class:`attnwarp_eval.truth.TwoView` defines them exactly.
"""
