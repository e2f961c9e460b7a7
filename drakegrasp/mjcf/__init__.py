"""Hands as models of MuJoCo (MJCF), objects as convex parts. Needs the extra `[peer]`."""
