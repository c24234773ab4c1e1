"""What the paper is called, and where it is."""

from __future__ import annotations

AUTHORS = "S. Tayade, P. Rost, A. Maeder"
TITLE = "Error Convergence Analysis and Stability of a Cloud Control AGV"
ARXIV = "2102.05385"
DOI = f"10.48550/arXiv.{ARXIV}"
"""The one that arXiv gives to each of its papers."""

CITATION = f"{AUTHORS}: {TITLE}. arXiv:{ARXIV}, doi:{DOI}"
