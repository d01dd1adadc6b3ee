"""Variety of a method's results between seeds, and their agreement within one."""
