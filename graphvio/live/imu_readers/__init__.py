"""Inertial sensors that are no part of a camera."""
