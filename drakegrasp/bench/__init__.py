"""What attempts cost, how much labels depend on choices, and the same attempts in MuJoCo."""
