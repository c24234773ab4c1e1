"""The shop floor and the air: the AGV and the radio channel."""
