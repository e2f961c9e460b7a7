"""A real SLURM for tests, in a folder of its own, as root."""
