"""Many sessions, each optimised by itself, side by side on Dask's workers."""
