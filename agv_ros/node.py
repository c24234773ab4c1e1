"""What the loop's nodes have in common: typed parameters, raw topics, counted rejections, diagnostics."""

from __future__ import annotations

import math
import time
import traceback
from collections import Counter
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.signals import SignalHandlerOptions

from agv_ros.codec import encode_diagnostics
from agv_ros.counted import counted
from agv_ros.endpoints import Output
from agv_ros.errors import UserError
from agv_ros.messages import CHANGED, PUBLISHED
from agv_ros.parameter_declaration import declare
from agv_ros.parameters import LoopParameters, ParameterError, as_dict, build, parameters_of
from agv_ros.qos import Input, create_publisher
from agv_ros.settling import Settling, has_all
from agv_ros.stamps import LATEST_NS, Grid
from agv_ros.stopping import STOPPED_BY

P = TypeVar("P", bound=LoopParameters)

_SETTLING = 1.0 / 6.0
"""Share of `stop_timeout` for which a node that is stopped takes part in a loop that goes on."""

_POLL_PERIOD = 0.01
"""How often [s] a node looks for its subscribers and peers while it waits for them."""

_PATIENCE = 3.0
"""After this time [s] a node that waits for its subscribers says so."""

_LOOK_PERIOD = 1.0
"""How often [s] a node looks for others that publish its topics."""

_OFFERS_PERIOD = 0.25
"""How often [s] it looks what is offered to its inputs."""

_ACK_PERIOD = 0.1
"""For how long [s] at a time a node waits until its subscribers have acknowledged what it has sent."""

ENDED = "ended"
"""Key in a node's last diagnostics: its counts of messages there are final."""


class LoopNode(Node, Generic[P]):
    """Base of the loop's nodes.

    `settings` are the parameters as they are now; `finished` turns True when the node has done its work, `failure`
    then says why if it did not succeed.
    """

    def __init__(self, name: str, schema: type[P], **node_options: Any) -> None:
        super().__init__(name, **node_options)
        self.settings: P = declare(self, schema)
        self.grid = Grid.of(self.settings.start_time, self.settings.ts)
        self.rejected: Counter[str] = Counter()
        """Messages by topic that must not enter the loop."""
        self.survived: Counter[str] = Counter()
        """Errors of other callbacks by their kind."""
        self.received: Counter[str] = Counter()
        """Messages that have come, by full name of the topic."""
        self._settling = Settling()
        self.finished = False
        self.failure = ""
        self.outputs: list[Output] = []
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._steps_per_report = max(1, round(1.0 / self.settings.ts))
        self._last_ns = self.grid.start_ns
        self._ended = False
        self._changes: dict[str, str] = {}
        self._uses_arguments = node_options.get("use_global_arguments", True)
        self._own_arguments = node_options.get("cli_args")
        self.sides: list[Node] = []
        """This node's participants in other DDS domains; to be spun with it."""
        self._diagnostics = self.output(DiagnosticArray, "/diagnostics", side=True)
        self._inputs: list[Input] = []
        self._unheard: dict[str, tuple[Output, ...]] = {}
        """Inputs that are not subscribed to yet, with the outputs that too few listen to."""
        self._tell_of_waiting_at = math.inf
        self._rivals: dict[str, str] = {}
        """Other publishers of this node's topics, as they were seen, by topic."""
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self.every(_LOOK_PERIOD, self._look_for_rivals)
        self.every(_OFFERS_PERIOD, self._look_at_offers)

    # -- domains -----------------------------------------------------------------------------------------------------

    def in_domain(self, domain_id: int) -> Node:
        """The node in a DDS domain: itself in its own, or if the id is negative; elsewhere another of its name."""
        for known in (self, *self.sides):
            if domain_id < 0 or known.context.get_domain_id() == domain_id:
                return known
        context = Context()
        arguments: list[str] | None = None if self._uses_arguments else []
        rclpy.init(args=arguments, context=context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
        self.sides.append(
            Node(
                self.get_name(), context=context, namespace=self.get_namespace(), start_parameter_services=False,
                enable_rosout=False, use_global_arguments=self._uses_arguments, cli_args=self._own_arguments,
            )
        )  # fmt: skip
        return self.sides[-1]

    def destroy_node(self) -> None:
        """Leave all domains."""
        for side in self.sides:
            side.destroy_node()
            side.context.try_shutdown()
        self.sides.clear()
        super().destroy_node()

    # -- topics ------------------------------------------------------------------------------------------------------

    def output(
        self, kind: type, topic: str, *, side: bool = False, optional: bool = False, on: Node | None = None
    ) -> Output:
        """Publisher of serialised messages of type `kind`; `side`: no node of the loop listens to it.

        To an `optional` topic one of ours listens, but maybe not another's in its place. `on` is this node `in_domain`.
        """
        publisher = create_publisher(on or self, kind, topic, self.get_logger().warning)
        self.outputs.append(Output(publisher, side, optional, on or self))
        return self.outputs[-1]

    def input(
        self, kind: type, topic: str, callback: Callable[[bytes], None], *feeds: Output, on: Node | None = None
    ) -> None:
        """Subscription to serialised messages; what `callback` refuses is counted under `topic`.

        It is made as soon as each output that it `feeds` has the wanted number of subscribers. A loop thus comes up
        backwards, from the plant's inputs to its output, and its first message is not lost. `on` is this node
        `in_domain`.
        """

        def receive(data: bytes) -> None:
            if self._ended:  # its last report has said how many messages it has published
                return
            self.received[full_name] += 1
            try:
                callback(data)
            except UserError:  # no other message can repair that
                raise
            except Exception as error:  # InvalidMessageError, OffGridError, or what no one has thought of
                self.reject(topic, error)

        where, wanted = on or self, self.settings.wait_for_subscribers
        self._unheard[topic] = feeds
        full_name = where.resolve_topic_name(topic)

        def subscribe_when_heard() -> bool:
            if not all(output.is_heard(wanted) for output in feeds):
                return False
            del self._unheard[topic]
            self.received[full_name] = 0
            self._inputs.append(Input(where, kind, topic, receive, self.get_logger().warning))
            return True

        self.poll(subscribe_when_heard)

    def announce(self) -> None:
        """Log, once, when all inputs are subscribed to; and what is waited for, if that takes long."""
        self._tell_of_waiting_at = time.monotonic() + _PATIENCE
        self.poll(self._is_announced)

    def _is_announced(self) -> bool:
        if not self._unheard:
            self.get_logger().info("ready")
        elif time.monotonic() > self._tell_of_waiting_at:
            self._tell_of_waiting_at = math.inf
            wanted = self.settings.wait_for_subscribers
            for output in self.outputs:
                if any(output in feeds for feeds in self._unheard.values()) and not output.is_heard(wanted):
                    self.get_logger().info(
                        f"waiting for those who listen to {output.topic}: wait_for_subscribers is {wanted}"
                    )
        return not self._unheard

    def every(self, period: float, callback: Callable[[], None]) -> None:
        """Call `callback` again and again, `period` [s] apart by the steady clock."""
        self.create_timer(period, callback, clock=self._steady)

    def poll(self, attempt: Callable[[], bool]) -> None:
        """Call `attempt` now and, until it returns True, again and again."""
        if attempt():
            return

        succeeded = False

        def again() -> None:
            # A timer that was destroyed can have one more event on its way, in the events executor.
            nonlocal succeeded
            if not succeeded and attempt():
                succeeded = True
                self.destroy_timer(timer)

        # On the steady clock: where use_sim_time is set, ROS time stands still until the loop runs.
        timer = self.create_timer(_POLL_PERIOD, again, clock=self._steady)

    def on_stop(self, reason: str) -> None:
        """Called when the node is asked to end before it has done its work, by a signal as in "SIGTERM"."""
        self.get_logger().info(f"{STOPPED_BY}{reason}")

    def is_settled(self) -> bool:
        """Has everything that is on its way to this node arrived? Polled for a moment when the node is stopped.

        Where its peers go on, as in a loop in lockstep, there is always more: after _SETTLING of `stop_timeout` it has.
        """
        return self._settling.is_over(self.received.total(), _SETTLING * self.settings.stop_timeout)

    def close(self) -> None:
        """Report for the last time what was published. From then on the node acts on nothing that comes or is due."""
        if self._ended:
            return
        self._ended = True
        for timer in self.timers:
            timer.cancel()
        self.report(self._last_ns)

    def published(self) -> Counter[str]:
        """Messages that were sent, by full name of the topic."""
        return Counter({output.topic: output.count for output in self.outputs})

    def has_received(self, published: Counter[str]) -> bool:
        """Has all come here of what was published, by full name of the topic? A node that was closed awaits nothing."""
        return self._ended or has_all(self.received, published)

    def flush(self, seconds: float, is_hurried: Callable[[], bool] = lambda: False) -> None:
        """Wait until all that was published has arrived, `seconds` at most: a dead subscriber acknowledges nothing."""
        deadline = time.monotonic() + seconds
        for output in self.outputs:
            while not output.flush(min(_ACK_PERIOD, max(0.0, deadline - time.monotonic()))):
                if time.monotonic() >= deadline or is_hurried():
                    return

    # -- what went wrong ---------------------------------------------------------------------------------------------

    def _look_at_offers(self) -> None:
        for one in self._inputs:
            one.look()

    def _look_for_rivals(self) -> None:
        """Name, once each, other nodes that publish this node's topics: what they send counts as this loop's."""
        for output in self.outputs:
            names = ", ".join(output.rivals())
            if names and names != self._rivals.get(output.topic):
                self._rivals[output.topic] = names
                self.get_logger().warning(
                    f"{names} also publishes {output.topic}, and what it sends counts as this loop's: use another "
                    "namespace or ROS_DOMAIN_ID"
                )
                self.report(self._last_ns)

    def reject(self, topic: str, error: Exception) -> None:
        """Count a message that must not enter the loop; the first of its topic is logged."""
        self.rejected[topic] += 1
        if self.rejected[topic] == 1:
            self.get_logger().warning(f"{topic}: message rejected: {_said(error)}; further ones are only counted")
            if not isinstance(error, ValueError):
                self.get_logger().debug("".join(traceback.format_exception(error)))
        self._report_now_and_then(self.rejected[topic])

    def survive(self, error: Exception) -> None:
        """Count an error of a callback that is not a message's, as of a service call; the first of a kind is logged."""
        self.survived[type(error).__name__] += 1
        if self.survived[type(error).__name__] == 1:
            self.get_logger().error(f"{_said(error)}; the node goes on, further ones are only counted")
            self.get_logger().debug("".join(traceback.format_exception(error)))
        self._report_now_and_then(self.survived[type(error).__name__])

    def _report_now_and_then(self, count: int) -> None:
        """Report the first, the second, the fourth ... The stamp of a message that was rejected may be anything."""
        if count & (count - 1) == 0:
            self.report(self._last_ns)

    def fail(self, reason: str) -> None:
        """End this node with an error."""
        self.failure = reason
        self.finished = True

    # -- diagnostics -------------------------------------------------------------------------------------------------

    def facts(self) -> dict[str, str]:
        """What this node reports in its diagnostics, beside what it rejected."""
        return {}

    def report_every_second(self, stamp_ns: int) -> None:
        """Publish diagnostics once per second of the loop's time, at whole seconds after step 0.

        Called before a step's answer is published, so that no other node's report of the step can come before it.
        """
        if stamp_ns > self._last_ns:
            self._last_ns = stamp_ns
        if self._period_of(stamp_ns) % self._steps_per_report == 0:
            self.report(stamp_ns)

    def _period_of(self, stamp_ns: int) -> int:
        """The step in whose period an instant lies: the stamps of other robots are not on the grid."""
        return (stamp_ns - self.grid.start_ns) // self.grid.ts_ns

    def report(self, stamp_ns: int) -> None:
        """Publish this node's diagnostics now."""
        total = sum(self.rejected.values())
        published = self.published()
        published[self._diagnostics.topic] += 1  # this report
        facts = self.facts() | {f"{PUBLISHED}{topic}": str(count) for topic, count in published.items()}
        facts |= self._changes
        facts |= {f"rejected {topic}": str(count) for topic, count in sorted(self.rejected.items())}
        facts |= {f"other publishers {topic}": names for topic, names in self._rivals.items()}
        facts |= {
            f"missed deadlines {one.topic}": str(one.missed_deadlines) for one in self._inputs if one.missed_deadlines
        }
        facts |= {f"errors {kind}": str(count) for kind, count in sorted(self.survived.items())}
        if self._ended:
            facts |= {ENDED: "true"}
        message = f"{counted(total, 'message')} rejected" if total else "ok"
        name = self.get_fully_qualified_name().lstrip("/")
        stamp_ns = min(max(0, stamp_ns), LATEST_NS)
        self._diagnostics.publish(encode_diagnostics(stamp_ns, int(total > 0), name, message, facts))

    # -- parameters --------------------------------------------------------------------------------------------------

    def on_settings(self) -> None:
        """Called when `settings` have changed while the node runs."""

    def _on_set_parameters(self, parameters: list[RosParameter[Any]]) -> SetParametersResult:
        known = parameters_of(type(self.settings))
        changed = {p.name: p.value for p in parameters if p.name in known}
        if not changed:  # rclpy's own, as those of QoS, also while the node is being made
            return SetParametersResult(successful=True)
        try:
            settings = build(type(self.settings), as_dict(self.settings) | changed, self.get_name())
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        before = as_dict(self.settings)
        self.settings = settings
        self.on_settings()
        self._say_changed(before)
        return SetParametersResult(successful=True)

    def _say_changed(self, before: dict[str, Any]) -> None:
        """Report what has another value than `before`, so that a recording says from which step on it holds."""
        after, k = as_dict(self.settings), self._period_of(self._last_ns)
        changed = {name: value for name, value in after.items() if value != before[name]}
        for name, value in changed.items():
            self._changes[f"{CHANGED}{name}"] = f"{before[name]} -> {value} after step {k}"
        if changed:
            self.report(self._last_ns)


def _said(error: Exception) -> str:
    """An error in a line; of one that is not about a value with its kind."""
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
