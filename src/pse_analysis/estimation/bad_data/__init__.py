"""Tests for gross errors: of residuals, of innovations, of a channel alone."""
