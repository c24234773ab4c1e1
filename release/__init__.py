"""Making a release: archives that are the same each time, with what belongs in them, and tried."""
