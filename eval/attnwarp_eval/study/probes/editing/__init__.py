"""A scene edited by a method, against the true pictures of the edit."""
