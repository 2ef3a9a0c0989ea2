"""A finished fit to the prediction folder that the evaluator reads. Imports reconstruct and below."""
