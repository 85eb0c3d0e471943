"""Data types that the stages exchange: measurements, motions, gate results, estimates and events."""
