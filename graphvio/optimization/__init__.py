"""Optimisation of recorded sessions: one graph of all measurements, with loop closures within and between sessions."""
