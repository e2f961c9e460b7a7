"""The files of a dataset: schema, shards, manifest, assembly, reading."""
