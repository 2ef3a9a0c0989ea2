"""The oracle baseline: the map that ground-truth normals give. Imports evaluation and below."""
