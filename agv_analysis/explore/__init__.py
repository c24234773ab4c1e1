"""What if? A page on this machine on which settings are changed and the lap is simulated again at every change.

`settings` turns what is on the page into a scenario, `respond` a scenario into figures and numbers, `layout` is what is
on the page, `positions` is between sliders and values, `app` answers.
"""
