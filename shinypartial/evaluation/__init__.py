"""A prediction folder against its dataset: scores and pictures. Imports prediction, metrics, dataset and below."""
