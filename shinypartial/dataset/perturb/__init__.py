"""Worse copies of a dataset: wrong cameras and masks, a poor sensor, fewer views, a turned world."""
