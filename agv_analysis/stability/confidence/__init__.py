"""How sure a finite recording makes a verdict in mean square; `link_confidence` is the way in."""
