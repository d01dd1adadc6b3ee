"""Surfaces of fits against true ones, beside depth, pictures and warps."""
