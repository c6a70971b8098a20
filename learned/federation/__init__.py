"""Training together: rules, participation, and the screening of bad updates."""
