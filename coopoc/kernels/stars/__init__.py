"""Filters of a star, an ego and its neighbours: messages, measurements, information form."""
