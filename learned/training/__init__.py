"""Training of nets: clients and their pieces, schedules, the loop."""
