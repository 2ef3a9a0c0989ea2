"""Scores of several runs: ranking, paired comparison, Pareto fronts. Imports evaluation and below."""
