"""Predictions and their verdicts on the page, beside the rows of the dataset that they are for."""
