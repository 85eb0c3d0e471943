"""Functions that all reports share: HTML templates, figures, and files that are either complete or absent."""
