"""Reading scenes.hdf5 to train on it."""
