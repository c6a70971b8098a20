"""The true fleet, and the measurements and messages of its vehicles."""
