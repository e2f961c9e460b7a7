"""What attempts cost: throughput, and the same attempts in MuJoCo."""
