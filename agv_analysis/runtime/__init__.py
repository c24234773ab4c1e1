"""Running the nodes: one process or several, fleets, replay, the recorder."""
