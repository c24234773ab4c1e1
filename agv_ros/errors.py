"""Errors that the user can correct."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO


class UserError(ValueError):
    """Something asked for that cannot be done; the text names it, what was found, what is allowed, what to do.

    Commands and nodes print the text alone and exit with status 1.
    """


class IrregularFileError(OSError):
    """A pipe, a socket or a device where a file is wanted: reading may never end."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(
            errno.EINVAL, "is a pipe or a device, not a file: write what comes out of it to a file first", path
        )


def refuse_irregular(path: str | os.PathLike[str]) -> None:
    """Raise IrregularFileError if there is something at `path` that is neither a file nor a directory."""
    try:
        mode = Path(path).stat().st_mode
    except (OSError, ValueError):  # opening it says so
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise IrregularFileError(path)


@contextmanager
def open_text(
    path: str, kind: type[UserError], encoding: str = "utf-8", newline: str | None = None
) -> Iterator[TextIO]:
    """A text file to read from; raises an error of this kind, naming the file, if it cannot be read or is not text."""
    try:
        refuse_irregular(path)
        with open(path, encoding=encoding, newline=newline) as file:
            yield file
    except UserError:  # what the reader of the file says of it
        raise
    except OSError as error:
        raise kind(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        if not isinstance(error, UnicodeDecodeError):  # a path with a NUL or a surrogate in it
            raise kind(f"{path!r}: is not the name of a file: {error}") from None
        raise kind(f"{path}: is not UTF-8 text: {error.reason} at byte {error.start}") from None
