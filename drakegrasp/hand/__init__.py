"""Hands: their files, links, kinematics and collision shapes."""
