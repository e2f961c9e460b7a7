"""Samplers of palm poses that are more than a function."""
