"""Monte Carlo campaigns and outages: ``scripts/campaign``."""
