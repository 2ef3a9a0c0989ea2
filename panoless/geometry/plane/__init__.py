"""A flat mirror: a plane with a boundary polygon. Imports the surfels that a free fit starts from."""
