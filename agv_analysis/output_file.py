"""Files that commands write: never through a link that leads elsewhere."""

from __future__ import annotations

from pathlib import Path

from agv_ros.errors import UserError


def output_file(path: Path | str) -> Path:
    """The path, to be written to. Raises UserError if a link at this place leads out of its directory.

    A recording may come from anybody, and its directory is where pictures go: a link in it must not choose the file.
    """
    path = Path(path)
    if path.is_symlink() and path.resolve().parent != path.parent.resolve() and path.parent != Path("/dev"):
        raise UserError(
            f"{path}: is a link to {path.resolve()}, out of its directory, and not written to: remove it or name "
            "another file"
        )
    return path
