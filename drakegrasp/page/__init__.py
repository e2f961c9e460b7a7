"""A local web page to look at a dataset, and to reject grasps."""
