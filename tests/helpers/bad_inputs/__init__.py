"""Kinds of bad input, in tables: each spoils one thing of one file, or is one bad option."""
