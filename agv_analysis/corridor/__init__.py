"""How far outages take the AGV off its track: which of them it survives within a corridor, and how often it leaves."""
