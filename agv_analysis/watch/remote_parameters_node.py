"""Parameters of a running loop's nodes, read and set by the services that every ROS 2 node has."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from agv_analysis.runtime.parameter_client_node import ParameterClient
from agv_analysis.scenario import SCHEMAS, Scenario, parse_scenario
from agv_ros.parameters import SHARED, ParameterError, parameters_of
from agv_ros.ros_yaml import dump

_PUBLISHERS = {"plant": "agv/pose", "relay": "agv/slot", "error_detector": "edge/error", "controller": "edge/cmd_vel"}
"""The topic by which each node of the loop is known, in the DDS domain in which its services are."""

_PATIENCE = 3.0
"""How long [s] a node may take to answer."""

_SPIN = 0.02

NAME = "watcher_parameters"
"""The node that asks; the one that listens is not spun."""


class RemoteParameters:
    """Reads and sets the parameters of a loop's nodes. Its methods may be called by several threads."""

    def __init__(self, agv: Node, edge: Node) -> None:
        self._lock = threading.Lock()
        self._executors: list[SingleThreadedExecutor] = []
        sides = {id(side): self._beside(side) for side in (agv, edge)}
        self._nodes = list(sides.values())
        self._at = {name: sides[id(edge if name in ("error_detector", "controller") else agv)] for name in _PUBLISHERS}
        self._setters: dict[str, Any] = {}
        self.longest_answer = 0.0
        """The longest time [s] that a node took to set a parameter."""
        self.is_plant_assumed = False
        """Is there a robot in place of the plant, of which nothing is known?"""
        self._clients = {name: ParameterClient(self._at[name], topic) for name, topic in _PUBLISHERS.items()}

    def _beside(self, side: Node) -> Node:
        node = Node(
            NAME, context=side.context, namespace=side.get_namespace(), use_global_arguments=False,
            enable_rosout=False, start_parameter_services=False,
        )  # fmt: skip
        self._executors.append(SingleThreadedExecutor(context=side.context))
        self._executors[-1].add_node(node)
        return node

    def names(self) -> dict[str, str]:
        """Full names of the loop's nodes, by their name here; only of those that have answered."""
        return {name: client.name for name, client in self._clients.items() if client.values is not None}

    def ask(self, again: bool = False) -> Scenario | None:
        """The parameters as the nodes have them now; None as long as not all have answered.

        A robot in place of the plant need not answer: then the plant's parameters are the defaults, in real time.
        Raises ParameterError if those of the others are not those of this package's nodes.
        """
        with self._lock:
            if again:
                for client in self._clients.values():
                    client.ask_again()
            self._spin_until(self._have_answered)
            found = {name: client.again.get(client.restarts, client.values) for name, client in self._clients.items()}
            if any(values is None for name, values in found.items() if name != "plant"):
                return None
            for name, values in found.items():  # so that they are connected when a parameter is to be set
                if values is not None:
                    self._setter_of(name)
        values = {
            name: {key: value for key, value in (found[name] or {}).items() if key in parameters_of(SCHEMAS[name])}
            for name in SCHEMAS
        }
        self.is_plant_assumed = not values["plant"]
        if self.is_plant_assumed:
            shared = {key: value for key, value in values["relay"].items() if key in SHARED}
            values["plant"] = {**shared, "clock": "realtime", "duration": math.inf}
        text = dump({name: {"ros__parameters": known} for name, known in values.items()})
        return parse_scenario(text, "the parameters of the running nodes")

    def connect(self) -> bool:
        """Look for the nodes, so that their parameters can be set at once; is each of them found? Asks them nothing."""
        with self._lock:
            for name, client in self._clients.items():
                if not client.name:
                    client.ask()  # which only looks, as long as it has not found the node
                if client.name:
                    self._setter_of(name)
            return len(self._setters) == len(self._clients)

    def _setter_of(self, node: str) -> Any:
        if node not in self._setters:
            where = f"{self._clients[node].name}/set_parameters"
            self._setters[node] = self._at[node].create_client(SetParameters, where)
        return self._setters[node]

    def _have_answered(self) -> bool:
        answered = [client.ask() for client in self._clients.values()]  # each is to be asked
        return all(answered)

    def set(self, node: str, name: str, value: Any) -> None:
        """Set a parameter of a node. Raises ParameterError if there is none, or the node refuses it or is silent."""
        known = parameters_of(SCHEMAS[node]).get(name)
        if known is None or not known.runtime:
            raise ParameterError(f"{node}.{name} is not a parameter that changes at run time")
        if known.kind in ("double", "integer"):
            value = float(value) if known.kind == "double" else int(value)
        value = known.check(node, value)
        client = self._clients[node]
        with self._lock:
            self._spin_until(lambda: bool(client.name) or client.ask())
            if not client.name:
                raise ParameterError(f"no {node} is to be seen: is it running?")
            service = self._setter_of(node)
            if not self._spin_until(service.service_is_ready):
                raise ParameterError(f"{client.name} does not offer to set its parameters: does it run?")
            begin = time.monotonic()
            request = SetParameters.Request(parameters=[RosParameter(name, value=value).to_parameter_msg()])
            answer = service.call_async(request)
            if not self._spin_until(answer.done):
                raise ParameterError(f"{client.name} has not answered within {_PATIENCE:g} s: does it run?")
            self.longest_answer = max(self.longest_answer, time.monotonic() - begin)
        (result,) = answer.result().results
        if not result.successful:
            raise ParameterError(result.reason or f"{client.name} refuses {name}={value}")

    def _spin_until(self, is_done: Callable[[], bool]) -> bool:
        deadline = time.monotonic() + _PATIENCE
        while not is_done():
            if time.monotonic() > deadline:
                return False
            for executor in self._executors:
                executor.spin_once(timeout_sec=_SPIN)
        return True

    def close(self) -> None:
        """Stop asking."""
        with self._lock:
            for executor in self._executors:
                executor.shutdown()
            for node in self._nodes:
                node.destroy_node()
