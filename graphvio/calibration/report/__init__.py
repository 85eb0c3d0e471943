"""The report of a calibration: page, figures and numbers."""
