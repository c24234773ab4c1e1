"""The AGV and the radio channel: vehicle, channel models, links; the nodes plant and relay."""
