"""Training together: rules, participation, compression, topologies, and the guard against bad updates."""
