"""Parts that all reports share: HTML templates, figures, and files that are whole or absent."""
