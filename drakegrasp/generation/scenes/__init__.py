"""Making scenes.hdf5: what is on the table, the cameras, and all closed hands."""
