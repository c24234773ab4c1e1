"""What if? A page on this machine on which settings are moved and the lap is simulated anew at every move.

`settings` turns what is on the page into a scenario, `respond` a scenario into figures and numbers, `app` is the page.
"""
