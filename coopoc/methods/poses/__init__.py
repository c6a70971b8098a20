"""Pose filters and smoothers: positions with headings, from what is measured on board."""
