"""The cost of attempts, and the same attempts in MuJoCo."""
