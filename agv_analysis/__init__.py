"""Offline: recordings, simulation, convergence, stability, command line."""
