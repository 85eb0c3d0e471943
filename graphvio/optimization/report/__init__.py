"""The report of an optimisation: an HTML page with figures, and all numbers as JSON."""
