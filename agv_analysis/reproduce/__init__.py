"""The paper, executable: its figures, every claim of its text with what was measured, and its future work.

S. Tayade, P. Rost, A. Maeder, Error Convergence Analysis and Stability of a Cloud Control AGV.

    runs       the paper's scenario, simulated or driven by the nodes and read from their bags
    outdated   the loop with a pose that is always n steps old, by a delay
    figures    the paper's figures, with their data as CSV
    claim      what a claim is, and what came out of it
    claims     the claims of the paper's text: how each is measured and judged
    future     its future work: gains for the other errors, outages, the criteria of stability against simulated twins
    report     the tables on the terminal, as Markdown and as JSON
"""
