"""Where the cameras are, by what they see of a geometry: outlines and mirrored light. Imports geometry and below."""
