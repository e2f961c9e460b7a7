"""Lifting by forces at the contacts alone, and measures of grasp quality."""
