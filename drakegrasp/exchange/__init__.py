"""Exchange: files of other tools become postures; a dataset is written in their formats."""
