"""Loop closure: recognition of places by any pair, and the relative pose between the visits."""
