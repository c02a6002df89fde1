"""Least squares on single snapshots."""
