"""Grasp attempts in Drake: objects at rest, palm poses, screen, trial, lift."""
