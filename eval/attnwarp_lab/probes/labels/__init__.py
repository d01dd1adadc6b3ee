"""Part labels carried along a warp."""
