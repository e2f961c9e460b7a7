"""Scores of predicted grasps beside reference rows: cards, and the frozen benchmark."""
