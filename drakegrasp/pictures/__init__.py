"""Contact sheets, third-person pictures, recordings."""
