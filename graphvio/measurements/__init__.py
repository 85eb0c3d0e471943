"""What stages hand each other: measurements, motions, gate results, estimates and events."""
