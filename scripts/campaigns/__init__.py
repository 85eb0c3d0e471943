"""Statistical claims by Monte Carlo: ``scripts/campaign``."""
