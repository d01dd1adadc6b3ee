"""The instrument judged by itself."""
