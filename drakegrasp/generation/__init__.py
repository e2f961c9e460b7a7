"""Building a dataset: objects prepared, work units simulated, files assembled and merged."""
