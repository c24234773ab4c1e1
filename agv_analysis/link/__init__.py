"""A radio link by itself: fits, Markov chains, netem figures, closed forms beside simulation."""
