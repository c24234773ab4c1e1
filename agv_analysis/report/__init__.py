"""A run for people to look at: on the terminal, on one page without a network, and as figures for a paper.

table               the figures of an analysis on the terminal, of one run or of several side by side
verdict_sentence    the verdict in one sentence
panels              what is drawn, named lines on named axes, whatever draws them
plotly              panels as figures of plotly.js
matplotlib_figures  panels as figures for a paper, SVG and PDF
overview            four panels on one sheet
margin_table        margins over the track as rows
page                the report of a run, one HTML file
sweep_page          the report of a sweep
"""
