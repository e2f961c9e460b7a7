"""Hand setup: drafts of hands, and checks before use: files, motion, grasps of simple objects."""
