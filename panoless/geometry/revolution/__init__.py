"""A surface of revolution: an axis and a profile. Imports the surfels that a free fit starts from."""
