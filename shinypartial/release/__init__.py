"""Datasets as a published release: card, checksums, archive, metadata. Imports dataset and below."""
