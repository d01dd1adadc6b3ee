"""Warps and masks of a user's capture against the tracks of structure from motion. See
docs/measuring/tracks.md."""
