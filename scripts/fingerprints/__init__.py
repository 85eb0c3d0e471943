"""``scripts/fingerprint``: digests of numerical results, to compare them before and after a change of the code."""
