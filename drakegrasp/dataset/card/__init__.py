"""The data card: what a dataset is, how it was made, how much it holds, and what it cannot."""
