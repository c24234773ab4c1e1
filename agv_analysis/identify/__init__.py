"""How a recorded robot follows its commands: dead time, lag, gain and slip, and the gains that they bear."""
