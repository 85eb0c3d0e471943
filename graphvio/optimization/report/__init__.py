"""What is written of an optimisation: all numbers, and a page for people with its pictures."""
