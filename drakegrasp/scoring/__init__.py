"""Scores of predicted grasps and of reference rows: cards, and the frozen benchmark."""
