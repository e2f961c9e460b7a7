"""Verification of predicted grasps in the simulator."""
