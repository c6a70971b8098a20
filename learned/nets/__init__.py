"""Nets that filter, as functions of flat weights."""
