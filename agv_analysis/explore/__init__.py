"""What if? A page on this machine on which settings are changed and the lap is simulated again at every change.

settings             what is on the page as a scenario
sliders, positions   what can be moved, and which value a position is
response             the lap of a scenario as figures and numbers, at once
background_criteria  what takes longer
page_layout          what is where
app                  the page, and its answers
guard                who may ask
"""
