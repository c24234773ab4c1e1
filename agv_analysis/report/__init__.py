"""A run for people to look at: one page without a network, and figures for a paper.

`panels` says what is drawn, named lines on named axes, whatever draws them. `plotly` makes figures of plotly.js of
them, `page` the report, one HTML file; `figures` draws them through matplotlib, as SVG and PDF.
"""
