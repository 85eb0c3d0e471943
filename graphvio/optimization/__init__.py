"""Sessions as a whole: the best trajectory that all of their measurements hold."""
