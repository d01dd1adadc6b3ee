"""Warps and masks of anybody's capture against the tracks of structure from motion. See
docs/measuring/tracks.md."""
