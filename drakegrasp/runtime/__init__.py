"""The process that does the work: files, progress, journal, environment."""
