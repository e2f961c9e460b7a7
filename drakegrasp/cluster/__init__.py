"""Running the work on Dask: the only room that knows it."""
