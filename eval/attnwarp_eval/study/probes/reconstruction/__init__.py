"""COLMAP's reconstructions of right edits and of flawed ones: what its figures see."""
