"""Scores of predicted grasps; grasps for what a camera saw, and their order."""
