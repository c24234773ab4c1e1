"""Who finds the nodes of this process: this host alone, unless its user says otherwise.

Imported before rclpy makes its first participant, since the middleware reads the environment then.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from pathlib import Path

DISCOVERY_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
"""Environment variable of ROS 2: which participants find each other."""

_STATIC_PEERS = "ROS_STATIC_PEERS"
"""Environment variable of ROS 2: hosts that are found beyond that range."""

_PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Environment variables of Fast DDS, up to version 2 and from version 3 on. Other middlewares ignore them."""

_LOOPBACK, _ANY_HOST = (str(Path(__file__).with_name(name)) for name in ("loopback.xml", "any_host.xml"))
"""Our profiles: for this host alone, and else. Both let a subscription have as many unread messages as its depth."""


def limit_to_this_host(environment: MutableMapping[str, str]) -> None:
    """Limit discovery to this host where nothing else is asked for, and then the sockets to the loopback interface.

    The range alone leaves sockets open on every interface. Profiles that the user has chosen stay; ours, inherited from
    a process with another range, do not.
    """
    environment.setdefault(DISCOVERY_RANGE, "LOCALHOST")
    is_local = environment[DISCOVERY_RANGE] in ("LOCALHOST", "OFF") and not environment.get(_STATIC_PEERS)
    is_others = any(environment.get(name, _LOOPBACK) not in (_LOOPBACK, _ANY_HOST) for name in _PROFILES)
    for name in _PROFILES:
        if not is_others:
            environment[name] = _LOOPBACK if is_local else _ANY_HOST
        elif environment.get(name) in (_LOOPBACK, _ANY_HOST):
            del environment[name]


def discovery_note() -> str:
    """Who can find the nodes of this process, and how to change that."""
    range_ = os.environ[DISCOVERY_RANGE]
    whom = {
        "LOCALHOST": f"this host alone finds the loop; with {DISCOVERY_RANGE}=SUBNET other hosts do",
        "OFF": "no other process finds the loop",
        "SUBNET": "every host of the network finds the loop and can send it messages",
    }.get(range_, "the middleware's own default holds")
    return f"discovery: {DISCOVERY_RANGE}={range_}, {whom}"


limit_to_this_host(os.environ)
