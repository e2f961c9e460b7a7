"""Triangle meshes: reading, repair, decimation, distance fields."""
