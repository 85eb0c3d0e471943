"""Public benchmarks: find the sequences of a data set in a folder, run them, and compare with published figures."""
