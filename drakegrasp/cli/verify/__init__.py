"""`drakegrasp verify`."""
