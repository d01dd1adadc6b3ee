"""Inspection of a warp in 3D, pixel by pixel, in a window, a picture or a file to share."""
