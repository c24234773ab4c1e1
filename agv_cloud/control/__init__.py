"""Control laws: from the tracking error to a command."""
