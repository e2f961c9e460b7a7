"""Figures of a dataset, its contact sheet, drawn scenes, recordings."""
