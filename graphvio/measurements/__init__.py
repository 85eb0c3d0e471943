"""What stages hand each other: measurements, estimates and measurements."""
