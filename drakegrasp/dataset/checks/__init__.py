"""Every invariant of a dataset, and what breaks it."""
