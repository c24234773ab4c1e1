"""Quality of service: what the loop's endpoints ask for and offer, and what is said where that does not fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.duration import Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from agv_ros.endpoints import LOOP_QOS, offer_of
from agv_ros.parameters import ParameterError

_BY_PARAMETER = (
    QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY,
    QoSPolicyKind.DEADLINE,
)  # fmt: skip
"""What `qos_overrides.<topic>.<publisher or subscription>.<policy>` sets."""


def create_publisher(node: Node, kind: type, topic: str, say: Callable[[str], None]) -> Publisher:
    """A publisher of a loop's topic; `say` is told once of a subscriber that asks for more than is offered.

    Raises ParameterError for a policy that there is not.
    """
    told: set[str] = set()

    def on_incompatible(event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        where = node.resolve_topic_name(topic)
        if policy not in told:
            told.add(policy)
            say(
                f"{where}: a subscriber asks for another {policy} than is offered, and hears nothing: set the "
                f"parameter qos_overrides.{where}.publisher.{policy} to what it asks for"
            )

    try:
        return node.create_publisher(
            kind, topic, _copy(LOOP_QOS), qos_overriding_options=QoSOverridingOptions(_BY_PARAMETER),
            event_callbacks=PublisherEventCallbacks(incompatible_qos=on_incompatible),
        )  # fmt: skip
    except RuntimeError as error:
        raise ParameterError(f"{node.resolve_topic_name(topic)}: {error}") from None


class Input:
    """A subscription to serialised messages that hears publishers of best effort as well as reliable ones.

    It asks for reliability, so that a loop in lockstep loses nothing, unless a parameter says otherwise or a publisher
    offers best effort, as drivers of sensors do. What it cannot mend itself, `say` is told once.
    """

    def __init__(
        self, node: Node, kind: type, topic: str, receive: Callable[[bytes], None], say: Callable[[str], None]
    ) -> None:
        self._node, self._kind, self._called, self._receive, self._say = node, kind, topic, receive, say
        self.topic: str = node.resolve_topic_name(topic)
        self.missed_deadlines = 0
        self._told: set[str] = set()
        self._is_chosen = f"qos_overrides.{self.topic}.subscription.reliability" in node._parameter_overrides
        self._is_best_effort = False
        self._is_due = True
        """May there be an offer that has not been looked at? To look all the time would cost a loop too much."""
        self._subscription: Subscription | None = None
        self._subscribe()
        self.look()
        self._is_due = False

    def look(self) -> None:
        """Hear publishers that have appeared meanwhile and offer best effort."""
        if self._is_chosen or self._is_best_effort or not self._is_due:
            return
        offer = offer_of(self._node, self.topic)
        if offer is not None and not offer.is_reliable:
            self._is_best_effort = True
            self._node.get_logger().info(f"{self.topic}: offered with best effort, and heard so")
            if self._subscription is not None:
                self._node.destroy_subscription(self._subscription)
            self._subscribe()

    def _subscribe(self) -> None:
        profile, policies = _copy(LOOP_QOS), [*_BY_PARAMETER]
        if self._is_best_effort:
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
            policies.remove(QoSPolicyKind.RELIABILITY)  # as its parameter is declared, it is reliable
        deadline = f"qos_overrides.{self.topic}.subscription.deadline"
        events = SubscriptionEventCallbacks(
            incompatible_qos=self._on_incompatible,
            deadline=self._on_deadline if deadline in self._node._parameter_overrides else None,
        )
        try:
            self._subscription = self._node.create_subscription(
                self._kind, self._called, self._receive, profile, raw=True, event_callbacks=events,
                qos_overriding_options=QoSOverridingOptions(policies),
            )  # fmt: skip
        except RuntimeError as error:
            raise ParameterError(f"{self.topic}: {error}") from None

    def _on_deadline(self, event: Any) -> None:
        self.missed_deadlines += event.total_count_change

    def _on_incompatible(self, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        if policy == "reliability" and not self._is_chosen:  # mended as soon as it is known what is offered
            self._is_due = True
            return
        if policy not in self._told:
            self._told.add(policy)
            self._say(
                f"{self.topic}: a publisher offers another {policy} than is asked for, and is not heard: set the "
                f"parameter qos_overrides.{self.topic}.subscription.{policy} to {self._offered(policy)}"
            )

    def _offered(self, policy: str) -> str:
        """What publishers offer, as the parameter has it."""
        infos = self._node.get_publishers_info_by_topic(self.topic)
        return " or ".join(sorted({_written(getattr(info.qos_profile, policy)) for info in infos})) or "what is offered"


def _written(value: Any) -> str:
    """A policy as its parameter has it; a duration in nanoseconds, 0 where there is no limit."""
    nanoseconds = getattr(value, "nanoseconds", None)
    if nanoseconds is None:
        return str(value.name).lower()
    return str(nanoseconds if nanoseconds < Infinite.nanoseconds else 0)


def _copy(profile: QoSProfile) -> QoSProfile:
    """rclpy writes overrides into the profile that it is given."""
    return QoSProfile(depth=profile.depth, reliability=profile.reliability)
