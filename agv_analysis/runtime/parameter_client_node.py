"""Asks a node for all its parameters, by the services that every ROS 2 node has, and waits for nothing."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from agv_ros.params_file import is_ros_own

_EAGER = 1000
"""So many looks come one after the other; if the node has not appeared by then, only each of ..."""

_SELDOM = 100
"""... so many is a look."""


class ParameterClient:
    """Parameters of the node that publishes a topic, once it has appeared and has answered.

    `name` is its full name, empty before it has appeared; `values` its parameters by name, None before it has answered;
    `again` those that it gave after it had been started again, by how often it had.
    """

    def __init__(self, node: Node, topic: str) -> None:
        """`node` asks; `topic` is resolved as one of its own."""
        self.name = ""
        self.values: dict[str, Any] | None = None
        self.again: dict[int, dict[str, Any]] = {}
        self.restarts = 0
        self._node, self._topic = node, topic
        self._list: Any = None
        self._get: Any = None
        self._looks = 0
        self._is_sent = False

    @property
    def is_waiting(self) -> bool:
        """Has it been asked, and has it not answered?"""
        return self._is_sent and not self._has_answered

    @property
    def _has_answered(self) -> bool:
        return self.values is not None and (self.restarts == 0 or self.restarts in self.again)

    def ask_again(self) -> None:
        """To be called when the node has been started again: what it says now may be something else."""
        self.restarts += 1
        self._is_sent, self._looks = False, 0

    def ask(self) -> bool:
        """Look for the node and ask it, unless it has been asked; has it answered? To be called again and again."""
        self._looks += 1
        if self._is_sent or (self._looks > _EAGER and self._looks % _SELDOM):
            return self._has_answered
        if not self.name:
            self._find()
        elif self._list.service_is_ready() and self._get.service_is_ready():
            self._is_sent = True
            self._list.call_async(ListParameters.Request()).add_done_callback(self._on_names)
        return False

    def _find(self) -> None:
        where = self._node.resolve_topic_name(self._topic)
        for publisher in self._node.get_publishers_info_by_topic(where):
            if publisher.node_name.startswith("_"):  # _NODE_NAME_UNKNOWN_: it is still being discovered
                continue
            self.name = f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
            self._list = self._node.create_client(ListParameters, f"{self.name}/list_parameters")
            self._get = self._node.create_client(GetParameters, f"{self.name}/get_parameters")
            return

    def _on_names(self, answer: Any) -> None:
        names = [name for name in answer.result().result.names if not is_ros_own(name)]
        request = GetParameters.Request(names=names)
        self._get.call_async(request).add_done_callback(lambda values: self._on_values(names, values.result().values))

    def _on_values(self, names: list[str], values: list[Any]) -> None:
        found = {name: parameter_value_to_python(value) for name, value in zip(names, values, strict=False)}
        said = {name: _plain(value) for name, value in found.items() if value is not None}
        if self.restarts:
            self.again[self.restarts] = said
        self.values = said if self.values is None else self.values


def _plain(value: Any) -> Any:
    """Arrays arrive as array.array or numpy arrays."""
    return list(value) if hasattr(value, "tolist") else value
