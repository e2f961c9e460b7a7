"""One grasp attempt in Drake: scene, candidates, screen, trial, lift."""
