"""Attacks on what runs: signals to its processes, wild messages on its topics, damaged bags. `make torture`."""
