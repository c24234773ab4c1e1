"""Nodes of this process: made with settings that are given, in DDS domains and namespaces of their own."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar

import rclpy
import rclpy.logging
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from agv_analysis.runtime.parameters import RecorderParameters
from agv_analysis.runtime.recorder_node import RecorderNode
from agv_ros.node import LoopNode
from agv_ros.parameter_declaration import overrides

N = TypeVar("N", bound=LoopNode[Any])
R = TypeVar("R", bound=RecorderNode)

_OWN_TOPICS = ["--ros-args", "-r", "/clock:=clock", "-r", "/diagnostics:=diagnostics"]
"""Remaps the topics that all nodes share into the namespace: each vehicle of a fleet has a clock of its own."""


class OneProcess:
    """Nodes of this process, in a context of their own."""

    def __init__(self, namespace: str = "") -> None:
        self.context = rclpy.Context()
        self._contexts: dict[int, rclpy.Context] = {}
        self._namespace = namespace
        self._stack = ExitStack()

    def __enter__(self) -> OneProcess:
        self._enter_domain(self.context, None)
        return self

    def _enter_domain(self, context: rclpy.Context, domain_id: int | None) -> None:
        rclpy.init(context=context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
        self._contexts[context.get_domain_id()] = context
        self._stack.callback(context.try_shutdown)

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(
        self, make: Callable[..., N], settings: object, use_sim_time: bool = False, domain_id: int = -1,
        vehicle: str = "",
    ) -> N:  # fmt: skip
        """Make a node with these settings, in a DDS domain of its own if it is to have one.

        The nodes of a `vehicle` of a fleet have this namespace, and in it clock and diagnostics of their own.
        """
        if domain_id >= 0 and domain_id not in self._contexts:
            self._enter_domain(rclpy.Context(), domain_id)
        node = make(
            parameter_overrides=[*overrides(settings), Parameter("use_sim_time", value=use_sim_time)],
            context=self._contexts.get(domain_id, self.context), use_global_arguments=False,
            namespace=vehicle or self._namespace, cli_args=_OWN_TOPICS if vehicle else None,
        )  # fmt: skip
        self._stack.callback(node.destroy_node)
        return node

    def add_recorder(self, settings: RecorderParameters, make: Callable[..., R], vehicle: str = "") -> R:
        """Make a recorder, which says in the run's Outcome alone what it has recorded."""
        recorder = self.add(make, settings, vehicle=vehicle)
        recorder.get_logger().set_level(rclpy.logging.LoggingSeverity.WARN)
        return recorder
