"""Splats fitted to true pictures, measured on views held out."""
