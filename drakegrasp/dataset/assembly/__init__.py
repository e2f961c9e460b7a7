"""Assembling in tasks: surveying shards, packing rows, writing samples."""
