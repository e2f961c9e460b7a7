"""The folder of a dataset for the Hugging Face Hub."""
