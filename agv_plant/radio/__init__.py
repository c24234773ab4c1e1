"""One direction of the radio link: which messages are lost, how late the others are, what the receiver holds."""
