"""Plain functions compiled with numba, one run at a time or over lanes, and the cache of what was compiled."""
