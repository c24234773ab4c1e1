"""Commands of `agv-ncs` in a process that is there already, whose imports take longer than most commands do.

As a script it runs those that it is sent, one a line.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import IO


@contextlib.contextmanager
def all_output() -> Iterator[IO[str]]:
    """A file to which goes what is said meanwhile in this process, also by ROS' logging, which asks no sys.stderr."""
    with tempfile.TemporaryFile(buffering=0) as raw, io.TextIOWrapper(raw, "utf-8", write_through=True) as file:
        kept = [(number, os.dup(number)) for number in (1, 2)]
        try:
            for number, _ in kept:
                os.dup2(raw.fileno(), number)
            with contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
                yield file
        finally:
            for number, copy in kept:
                os.dup2(copy, number)
                os.close(copy)


def run_command(words: list[str]) -> tuple[int, str]:
    """Exit status and output of a command of `agv-ncs` in this process."""
    from agv_analysis.cli import main

    with all_output() as file:
        status: object = None
        try:
            main(words, prog_name="agv-ncs")
        except SystemExit as end:
            status = end.code
        except Exception:  # as an interpreter says it
            traceback.print_exc()
            status = 1
        file.seek(0)
        return int(str(status or 0)), "\n".join(file.read().splitlines())


if __name__ == "__main__":
    # This folder holds folders that are called as the packages are; those of another environment come first.
    sys.path.append(str(Path(sys.path.pop(0)).parent))
    for line in sys.stdin:
        print("done:", json.dumps(run_command(json.loads(line))), flush=True)
