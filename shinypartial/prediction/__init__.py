"""The prediction folder: its format, and post-processing in it. Imports dataset and below."""
