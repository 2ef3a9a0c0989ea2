"""A mirror in panes: a smooth height over each cell of a plane. Imports the plane and the height field."""
