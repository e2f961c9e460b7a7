"""What may differ from attempt to attempt of an object: friction, mass, looks, cameras."""
