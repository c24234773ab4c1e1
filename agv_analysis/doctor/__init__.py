"""What of this machine matters to the loop: versions, middleware, clocks, cores, leftovers, and a timed loop."""
