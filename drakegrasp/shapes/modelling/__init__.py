"""How the shapes are made: curves, solids, parts and booleans."""
