"""Shapes of the built-in classes, by families."""
