"""Building a dataset: objects prepared, work units simulated, what they cost."""
