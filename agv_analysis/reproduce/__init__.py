"""The paper, executable: its figures, every claim of its text with what was measured, and its future work.

S. Tayade, P. Rost, A. Maeder, Error Convergence Analysis and Stability of a Cloud Control AGV.

    runs            the paper's scenario, simulated or driven by the nodes and read from their bags
    constant_delay  the loop with a pose that is always n steps old, by a delay
    figures         the paper's figures, with their data as CSV
    claim           what a claim is, and its result
    claims          the claims of the paper's text: how each is measured and judged
    future          its future work: gains for the other errors, outages, stability criteria against simulated twins
    policies        staleness and downlink policies, ranked on the same outages
    dot_plot        results of the future work as figures
    report          the tables on the terminal, as Markdown and as JSON
"""
