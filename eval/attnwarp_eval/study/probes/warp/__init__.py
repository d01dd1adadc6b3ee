"""Warp and mask of a variant against exact correspondences and visibility."""
