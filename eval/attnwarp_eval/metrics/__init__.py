"""Metrics of pictures and embeddings: pure functions, no I/O."""

from attnwarp_eval.metrics.embedding import Similarity, clip_similarity, directional_similarity, image_similarity

__all__ = ["Similarity", "clip_similarity", "directional_similarity", "image_similarity"]
