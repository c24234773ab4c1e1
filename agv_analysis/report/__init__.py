"""A run for people to look at: on the terminal, on one page without a network, and as figures for a paper.

    table               the figures of an analysis, and the margins of a scenario, on the terminal
    verdict_sentence    the verdict in one sentence
    panels              what is drawn, named lines on named axes, whatever draws them
    eigenvalues         the paper's along a run, and the lifted system's
    plotly              panels as figures of plotly.js
    matplotlib_figures  panels as figures for a paper, SVG and PDF
    overview            four panels on one sheet
    margin_map_files    a map of margins as CSV and picture
    tiles               the row of figures under the report's sentence
    cannot_say          what a run leaves open
    parameter_lines     parameters, and which are not the defaults
    packed              figures as compressed text in a page
    page                the report of a run, one HTML file
    sweep_page          the report of a sweep; sweep_table: its ten columns
    map_page            the page of a map of margins

`panels` says what is drawn; everything that draws walks them.
"""
