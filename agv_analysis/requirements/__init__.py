"""What a loop asks of its radio, in the words of those who plan radios, and whether a link gives it."""
