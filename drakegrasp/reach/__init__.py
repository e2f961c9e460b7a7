"""Whether a robot arm gets its hand to a grasp: arms, branches, collisions, rows of a dataset."""
