"""Named rules by which a grasp is judged, and the trials of those that run in MuJoCo."""
