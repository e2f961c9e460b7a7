"""The palm pose that brings the fingertips to predicted contacts."""
