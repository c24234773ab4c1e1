"""Figures of a run: convergence of the error, outages and age of information, confidence intervals."""
