"""Comparisons of all representations with publications, closed forms, a measured head and other toolboxes."""
