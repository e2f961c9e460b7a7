"""Checks of a hand before it is used: files, motion, and grasps of simple objects."""
