"""A graph solved by its robots, which exchange what they share."""
