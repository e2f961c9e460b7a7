"""The public calls that need workers."""
