"""Errors that the user can correct."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO


class UserError(ValueError):
    """Something asked for that cannot be done; the text names it, what was found, what is allowed, what to do.

    Commands and nodes print the text alone and exit with status 1.
    """


@contextmanager
def open_text(
    path: str, kind: type[UserError], encoding: str = "utf-8", newline: str | None = None
) -> Iterator[TextIO]:
    """A text file to read from; raises an error of this kind, naming the file, if it cannot be read or is no text."""
    try:
        with open(path, encoding=encoding, newline=newline) as file:
            yield file
    except OSError as error:
        raise kind(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise kind(f"{path}: is not UTF-8 text: {error.reason} at byte {error.start}") from None
