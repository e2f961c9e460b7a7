"""Loaders: the samples of a dataset for a library of machine learning."""
