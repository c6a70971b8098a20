"""Outliers: graduated non-convexity, and candidates that known inliers predict."""
