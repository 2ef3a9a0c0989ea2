"""How far methods bear worse data: a plan of our own commands, run by Snakemake, and the page that it gives.

Runs every method as a command on folders; may import pages, scores, formats and recipes, never the generator.
"""
