"""Real servers for tests, each in a folder of its own, as root: SLURM and sshd."""
