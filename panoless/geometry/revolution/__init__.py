"""A surface of revolution: an axis and a profile."""
