"""Wrists with joints from outside, and how they are tried."""
