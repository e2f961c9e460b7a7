"""Drafting a hand file from a model: what can be guessed from its shapes and joints."""
