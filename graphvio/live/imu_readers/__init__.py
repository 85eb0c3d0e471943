"""Readers of IMUs that are not part of a camera."""
