"""Fuzzing the bag reader: `make fuzz`, or `python -m fuzz --cases N`.

Each case is a small bag to which something was done. Where an independent reader (the libraries mcap and
mcap-ros2-support, or sqlite3) can read it, what we read must be the same, or said to be damaged. A case is a pure
function of the seed and its number, so that each can be repeated.
"""
