"""Scenes with exact answers, and the checks of warp, mask and depth against them."""
