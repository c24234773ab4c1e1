"""Errors that are for the person who made them."""

from __future__ import annotations


class UserError(ValueError):
    """Something asked for that cannot be done; the text names it, what was found, what is allowed, what to do.

    Commands and nodes print the text alone and exit with status 1.
    """
