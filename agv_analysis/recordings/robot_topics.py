"""Which topics of a robot hold its pose, its commands and its reference."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from agv_ros.errors import UserError
from agv_ros.ros_yaml import RosYamlError, load


class RobotTopics(NamedTuple):
    """Topics of a robot by what they mean; None: not in the recording."""

    pose: str
    command: str | None = None
    reference: str | None = None


def read_topics(path: Path | None, pose: str | None, command: str | None, reference: str | None) -> RobotTopics:
    """Topics from a YAML mapping with the keys pose, command, reference; names that are given here go before it.

    Raises UserError if the file cannot be used, or the pose is not named.
    """
    names = {} if path is None else _mapping(path)
    given = {"pose": pose, "command": command, "reference": reference}
    names.update({role: name for role, name in given.items() if name is not None})
    if "pose" not in names:
        raise UserError("no topic of the pose: name it with --pose-topic, or as `pose:` in the file of --topics")
    return RobotTopics(**names)


def _mapping(path: Path) -> dict[str, str]:
    try:
        content = load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    except (RosYamlError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: {error}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: no mapping in it; expected lines like 'pose: /odom'")
    for role, name in content.items():
        if role not in RobotTopics._fields or not isinstance(name, str):
            allowed = ", ".join(RobotTopics._fields)
            raise UserError(f"{path}: found {role!r}: {name!r}; allowed are {allowed}, each with the name of a topic")
    return content
