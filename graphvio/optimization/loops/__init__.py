"""Loop closure: recognition of places by any pair, and estimation of the relative pose between two visits."""
