"""Public benchmarks: finds the sequences of a data set in a folder, runs them, and compares with published figures."""
