"""Digests of numerical results, to be compared before and after a change: ``scripts/fingerprint``."""
