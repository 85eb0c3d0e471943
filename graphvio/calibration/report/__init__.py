"""What is written of a calibration: all numbers, pictures, and a page for people."""
