"""The reference: tracks, track files and paths, sampled by the loop."""
