"""Photographs to training views: cameras, masks, rays and encodings. Imports config, numeric, kernels and
shinypartial's formats.
"""
