"""Hands and objects as models of MuJoCo (MJCF). Needs the extra `[peer]`."""
