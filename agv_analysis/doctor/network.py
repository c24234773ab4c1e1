"""Where DDS looks for other nodes: domain, range, ports."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from agv_ros.errors import UserError

LARGEST_DOMAIN = 101
"""Above it, ports are among those that Linux gives to any program."""


def ports(domain: int, participants: int) -> dict[str, list[int]]:
    """UDP ports of a domain with `participants` on a host, a process and domain each: `multicast` and `unicast`.

    DDS Interoperability Wire Protocol (DDSI-RTPS) 2.5, 9.6.2: PB = 7400, DG = 250, PG = 2, d0 .. d3 = 0, 10, 1, 11.
    Raises UserError for a domain that has no ports.
    """
    base = 7400 + 250 * domain
    unicast = [base + offset + 2 * number for number in range(participants) for offset in (10, 11)]
    if not 0 <= domain <= 232 or max(unicast, default=base) > 65535:
        raise UserError(f"domain {domain}: must be in 0 .. 232, with ports up to 65535")
    return {"multicast": [base, base + 1], "unicast": unicast}


def discovery(environment: Mapping[str, str] = os.environ) -> dict[str, Any]:
    """Domain, discovery range and what else of the environment says where nodes look for each other.

    `domain` is None if ROS_DOMAIN_ID is not a number; ports are those of the first ten processes.
    """
    said = environment.get("ROS_DOMAIN_ID", "")
    domain = int(said or 0) if not said or said.isdecimal() else None
    try:
        used = None if domain is None else ports(domain, 10)
    except UserError:
        used = None
    return {
        "domain": domain,
        "domain_said": said,
        "range": environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "") or "not set",
        "static_peers": environment.get("ROS_STATIC_PEERS", ""),
        "discovery_server": environment.get("ROS_DISCOVERY_SERVER", ""),
        "profiles": environment.get("FASTRTPS_DEFAULT_PROFILES_FILE", "") or environment.get("CYCLONEDDS_URI", ""),
        "security": environment.get("ROS_SECURITY_ENABLE", "") == "true",
        "udp_ports": used,
    }
