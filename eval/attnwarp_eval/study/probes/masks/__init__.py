"""Masks of a thing, lifted through splats into other views."""
