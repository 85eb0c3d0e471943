"""Loop closure: places that are seen again, by any pair, and where the rig was then."""
