"""Inspection of a warp in 3D: what each pixel sees, in a window, a picture or a file to share."""
