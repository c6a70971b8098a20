"""Pose filters: positions with headings, from what is measured on board."""
