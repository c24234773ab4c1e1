"""Text of others, as names in a bag, to be shown on a terminal."""

from __future__ import annotations

import unicodedata

_UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Categories of characters that are not signs: control, format (as what turns the direction), surrogates, breaks."""


def printable(text: str) -> str:
    r"""The text with each character that a terminal would obey in place of showing it as an escape: \x1b, \u202e."""
    return "".join(
        _escaped(sign) if unicodedata.category(sign) in _UNSEEN and sign not in "\n\t" else sign for sign in text
    )


def _escaped(sign: str) -> str:
    return sign.encode("unicode_escape", "surrogatepass").decode()
