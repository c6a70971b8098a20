"""How nets are trained: clients and their pieces, schedules, the loop."""
