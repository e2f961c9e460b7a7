"""What an HDF5 file of a dataset must look like, by the schema; no row is read for it."""
