"""The page beside a running loop: what its topics say, ten minutes back, and the margin on the link seen so far."""
