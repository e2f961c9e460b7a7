"""Proving a hand before it is used: files, motion, and a grasp of two simple objects."""
