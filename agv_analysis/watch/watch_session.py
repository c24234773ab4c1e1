"""A loop that is watched: what was heard, the margin that is computed beside it, and what the page asks for."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from agv_analysis.explore.background_criteria import LatestOnlyWorker, WorkerDiedError
from agv_analysis.scenario import Scenario
from agv_analysis.watch.controls import controls_of
from agv_analysis.watch.foxglove_server import Send
from agv_analysis.watch.link_margin import LinkMargin, link_margin
from agv_analysis.watch.live_loop import DIAGNOSTICS, MINUTES, LiveLoop
from agv_analysis.watch.live_tiles import LiveTile, live_tiles
from agv_analysis.watch.message_log import MessageLog
from agv_analysis.watch.outage_order import with_outage
from agv_analysis.watch.saved_bag import save_bag
from agv_cloud.parameters import PATH
from agv_cloud.reference.reference import Reference, lap_steps
from agv_ros.counted import counted
from agv_ros.messages import CHANGED
from agv_ros.parameters import ParameterError, as_dict

if TYPE_CHECKING:
    from agv_analysis.watch.remote_parameters_node import RemoteParameters
    from agv_analysis.watch.watcher_node import WatcherNode

TICK = 0.05
"""Time [s] between two frames."""

_FIGURES = 4
"""Frames between two looks at the figures: no reader takes in more than five a second."""

_LEAD = 0.4
"""An outage that is asked for begins at least this much later [s], when the relay should know of it."""

_LEAST_REST, _SHARE = 5.0, 9.0
"""Between two margins pass so many seconds and so many times what the last one took: a tenth of a core at most."""

_MORE = 0.4
"""A margin is computed anew once it lacks such a share of the slots or of the losses that it was computed from."""

_QUIET = 1.0
"""After so long [s] without a slot the page says that nothing comes."""

_ASK_AGAIN = 0.25

_FAREWELL = 3.0
"""How long [s] the end waits for pages that have not taken the last frame."""


class Edition(NamedTuple):
    """How often what a page shows, but for its points, has changed; each is -1 before its first frame."""

    run: int = -1
    parameters: int = -1
    figures: int = -1


class _Evidence(NamedTuple):
    """What a margin is computed from."""

    setting: tuple[object, ...]
    """The run, its parameters, why they are not covered, and the longest outage: each of them changes the margin."""
    slots: int
    lost: int
    """Since the loop began."""
    window: float
    """The most slots that are kept."""

    def is_news_after(self, before: _Evidence | None) -> bool:
        """Is it so much more than what the last margin was computed from?"""
        if before is None or self.setting != before.setting:
            return True
        more = 1.0 + _MORE * min(1.0, before.window / max(before.slots, 1))
        return self.slots > more * before.slots or self.lost > more * before.lost


class WatchSession:
    """What the page shows. `tick` is for one thread; what the page asks for may come from others."""

    def __init__(
        self, watcher: WatcherNode, remote: RemoteParameters, scenario: Scenario | None, folder: Path,
        stop: Callable[[], None] | None, send: Send | None = None,
    ) -> None:  # fmt: skip
        """`scenario`: None if the nodes are to be asked. `stop` ends the run, None if that is not ours to end.

        `send` receives all messages, too.
        """
        self.watcher, self.folder, self.stop, self._send = watcher, folder, stop, send
        self.log = MessageLog(60.0 * MINUTES)
        self.loop: LiveLoop | None = None
        self.changed = threading.Condition()
        self.frames = 0
        self._ended = threading.Event()
        self.viewers = 0
        self.margin: LinkMargin | None = None
        self._begun_with: Scenario | None = None
        self._runs = self._edition = 0
        """How often the loop has begun anew, and its parameters have been others."""
        self._deadlines: dict[str, str] = {}
        self._figures: list[LiveTile] = []
        self._figures_at, self._figures_of = 0, (-1, False)
        """The frame for which they were looked up; its run, and had the session ended?"""
        self._changes: dict[tuple[str, str], str] = {}
        self._is_stale = scenario is None
        """Are the nodes to be asked for their parameters?"""
        self._is_over = False
        self._last_slot_at = time.monotonic()
        self._rate, self._rate_of = 0.0, (time.monotonic(), 0)
        self._remote = remote
        self._compute: LatestOnlyWorker[LinkMargin] = LatestOnlyWorker(link_margin)
        self._threads = [threading.Thread(target=work) for work in (self._keep_parameters, self._keep_margin)]
        if scenario is not None:
            self._adopt(scenario)
        for thread in self._threads:
            thread.start()

    @property
    def is_closed(self) -> bool:
        """Has the session ended?"""
        return self._ended.is_set()

    def end(self) -> None:
        """Let the pages have what came last, and their connections end."""
        with self.changed:
            self._ended.set()
            self.changed.notify_all()
            self.changed.wait_for(lambda: self.viewers == 0, _FAREWELL)

    def add_viewer(self, count: int) -> None:
        """One page more, or with -1 one less."""
        with self.changed:
            self.viewers += count
            self.changed.notify_all()

    def wait_for_frame(self, seen: int) -> None:
        """Wait, with `changed` held, until there is another frame than number `seen`, or the session ends."""
        self.changed.wait_for(lambda: self.frames != seen or self.is_closed)

    def close(self) -> None:
        """Stop computing and asking."""
        self.end()
        self._compute.close()
        for thread in self._threads:
            thread.join()

    # -- listening -----------------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Take in what has come, and let the page have it."""
        heard = self.watcher.drain()
        if self._send is not None:
            self._send(self.watcher.names(), self.watcher.types(), heard)
        with self.changed:
            self.log.add(heard)
            for message in heard:
                if message.topic == DIAGNOSTICS:
                    for name, facts, has_ended in self.watcher.reports_in(message.data):
                        self._note(name, facts, has_ended)
            if self.loop is not None:
                before, restarts = self.loop.k, self.loop.restarts
                self.loop.take(heard)
                if self.loop.restarts != restarts:
                    self._begin_anew()
                if self.loop.k != before:
                    self._last_slot_at = time.monotonic()
                self.loop.make_points(self._is_over)
                self._measure_rate(self.loop)
            self.frames += 1
            self.changed.notify_all()

    def _begin_anew(self) -> None:
        self.log.clear()
        self._is_over, self.margin, self._deadlines, self._is_stale = False, None, {}, True
        self._begun_with = None
        self._runs += 1

    def _note(self, name: str, facts: dict[str, str], has_ended: bool) -> None:
        if name == "plant":
            self._deadlines, self._is_over = facts, has_ended
        for key, value in facts.items():
            if key.startswith(CHANGED) and self._changes.get((name, key)) != value:
                self._changes[name, key] = value
                self._is_stale = True

    def _keep_parameters(self) -> None:
        """Body of a thread: ask the nodes for their parameters when they are not known, or have been changed."""
        is_asked = is_connected = False
        while not self.is_closed:
            is_connected = is_connected or self._remote.connect()
            if self._is_stale:
                self._is_stale = False
                try:
                    found = self._remote.ask(again=is_asked)
                except ParameterError as error:
                    found, self._refusal = None, str(error)
                if found is None:
                    self._is_stale = not self._is_over
                else:
                    is_asked = True
                    self._adopt(found)
            self._ended.wait(_ASK_AGAIN)

    _refusal = ""

    def _adopt(self, scenario: Scenario) -> None:
        """Take parameters as those of the loop; where its steps or its track are others now, hear all again."""
        with self.changed:
            if self.loop is None or _heard_by(self.loop.scenario) != _heard_by(scenario):
                self.loop = LiveLoop(scenario)
                self.loop.take(sorted(self.log.messages(), key=lambda heard: heard.topic))
                self._runs += 1
            self._begun_with = self._begun_with or scenario
            if self.loop.scenario != scenario or not self._edition:
                self.loop.scenario = scenario
                self._edition += 1

    # -- the margin ----------------------------------------------------------------------------------------------------

    def _keep_margin(self) -> None:
        """Body of a thread: compute the margin again and again, in a process of its own."""
        rest, is_first, before = _LEAST_REST, True, None
        while not self._ended.wait(rest):
            rest = _LEAST_REST
            with self.changed:
                loop, now = self.loop, self._evidence()
                if loop is None or now is None or not now.is_news_after(before):
                    continue
                k, lost = loop.ring.seen("lost", loop.k + 1)
                scenario, not_covered = loop.scenario, loop.not_covered()
            begin, before = time.monotonic(), now
            try:
                found = self._compute(scenario.to_yaml(), k, lost > 0.0, not_covered)
            except WorkerDiedError as error:
                found, before = LinkMargin("Not computed", str(error)), None
            if found is not None and self.loop is loop:
                self.margin = found
            if not is_first:  # which has to start the other process
                rest = max(_LEAST_REST, _SHARE * (time.monotonic() - begin))
            is_first = False

    def _evidence(self) -> _Evidence | None:
        """What a margin would be computed from now; None: there is none to compute."""
        loop = self.loop
        if loop is None or loop.k < 0 or loop.scenario.error_detector.track == PATH:
            return None
        setting = self._runs, self._edition, loop.not_covered(), loop.longest_outage
        return _Evidence(setting, loop.slots, loop.lost, 60.0 * MINUTES / loop.ts)

    # -- what the page gets --------------------------------------------------------------------------------------------

    def frame(self, since: int, edition: Edition) -> tuple[str, int, Edition]:
        """A frame with the points from number `since` on, as JSON, the number of the next one, and the edition.

        What has changed since the edition that the page has is in it as well: parameters, figures, of another run all
        points.
        """
        loop = self.loop
        content: dict[str, Any] = {"state": self._state()}
        if loop is None:
            return json.dumps(content), 0, edition
        self._look_at_figures(loop)
        now = Edition(self._runs, self._edition, self._figures_at)
        if edition[:2] != now[:2]:
            content["setup"] = self._setup(loop)
            content["anew"] = edition.run != now.run
            since = 0 if content["anew"] else since
        if edition != now:
            content["tiles"] = self._figures
        first = max(0, since - loop.points_before)
        content["points"] = [[_rounded(value) for value in point] for point in loop.points[first:]]
        k, deviation = loop.latest_deviation()
        content["now"] = {
            "k": loop.k, "first": loop.first, "slots": loop.slots, "skipped": loop.skipped, "lost": loop.lost,
            "longest": loop.longest_outage, "deviation_k": k, "deviation": None if math.isnan(deviation) else deviation,
            "settled": loop.settled_at, "x": _rounded(loop.latest("x")), "y": _rounded(loop.latest("y")),
        }  # fmt: skip
        return json.dumps(content), loop.points_before + len(loop.points), now

    def _look_at_figures(self, loop: LiveLoop) -> None:
        of_run = self._runs, self.is_closed
        if of_run != self._figures_of or self.frames >= self._figures_at + _FIGURES:
            self._figures = live_tiles(loop, self.margin, self._deadlines)
            self._figures_of, self._figures_at = of_run, self.frames

    def _state(self) -> str:
        if self._is_over:
            return "the loop has ended; what was seen of it stays here"
        quiet = time.monotonic() - self._last_slot_at
        if self.loop is None:
            return self._refusal or "waiting for the parameters of the loop's nodes: do they run, and in this domain?"
        if self.loop.k < 0:
            return "waiting for the loop to begin"
        if quiet > _QUIET:
            return f"nothing has come for {quiet:.0f} s"
        return "the plant did not tell its parameters: its defaults are taken" if self._remote.is_plant_assumed else ""

    def _setup(self, loop: LiveLoop) -> dict[str, Any]:
        scenario = loop.scenario
        return {
            "title": f"agv_ncs: {self.watcher.namespace or 'the loop'}",
            "track": _track_of(scenario),
            "corridor": scenario.error_detector.corridor,
            "controls": controls_of(scenario),
            "can_stop": self.stop is not None,
            "ts": loop.ts,
        }

    # -- what the page asks for ----------------------------------------------------------------------------------------

    def set(self, target: str, value: Any) -> str:
        """Set a parameter `node.name`. Raises ParameterError."""
        if target not in {control["target"] for control in controls_of(self._known().scenario)}:
            raise ParameterError(f"{target!r} cannot be set here")
        node, _, name = target.partition(".")
        self._remote.set(node, name, math.inf if value is None else value)
        self._is_stale = True
        return f"{target} = {'no limit' if value is None else f'{value:g}'}"

    def lose(self, slots: int | None, seconds: float) -> str:
        """Lose the next slots of the uplink, or all for some seconds. Raises ParameterError."""
        with self.changed:
            loop = self._known()
            if loop.scenario.relay.stamps != "grid":
                raise ParameterError("the relay's numbers of the slots are not known here: the stamps are on no grid")
            lead = max(_LEAD, 2.0 * self._remote.longest_answer)
            begin = loop.k + 1 + math.ceil(lead * max(1.0 / loop.ts, self._rate))
            count = slots if slots is not None else max(1, round(seconds / loop.ts))
            schedule = with_outage(loop.scenario.relay.uplink, begin, count, loop.ts)
        self._remote.set("relay", "uplink.schedule", schedule)
        with self.changed:
            values = as_dict(loop.scenario.relay) | {"uplink.schedule": schedule}
            loop.scenario = loop.scenario.with_values({"relay": values})
        self._is_stale = True
        late = (
            ""
            if loop.k < begin
            else f", but the relay may have known of it only at slot {loop.k}: those before went on"
        )
        return f"slots {begin} to {begin + count - 1} ({begin * loop.ts:.3f} s on) are lost{late}"

    def _measure_rate(self, loop: LiveLoop) -> None:
        """Once a second: how many steps does the loop take in a second?"""
        (at, k), now = self._rate_of, time.monotonic()
        if now - at >= 1.0 or loop.k < k:
            self._rate = max(0.0, (loop.k - k) / (now - at))
            self._rate_of = now, loop.k

    def save(self) -> str:
        """Write what was heard so far to a new bag. Raises UserError, OSError."""
        path = self.folder / f"watched_{time.strftime('%Y%m%d_%H%M%S')}"
        begun = self._begun_with or self._known().scenario
        names, types = self.watcher.names(), self.watcher.types()
        count = save_bag(path, self.log, names, types, begun, self._remote.names())
        return f"{path}: {counted(count, 'message')}"

    def _known(self) -> LiveLoop:
        if self.loop is None:
            raise ParameterError("the parameters of the loop's nodes are not known yet")
        return self.loop


def _heard_by(scenario: Scenario) -> tuple[object, ...]:
    """What decides what the messages of a loop mean."""
    plant, relay, detector = scenario.plant, scenario.relay, scenario.error_detector
    track = (detector.track, detector.track_file, detector.track_start, detector.lap_time, detector.speed)
    return plant.ts, plant.start_time, relay.stamps, relay.pose_type, relay.command_type, *track


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)


def _track_of(scenario: Scenario) -> list[list[float]]:
    """Places of a lap to draw [m], at most some hundred."""
    if scenario.error_detector.track == PATH:
        return []
    reference, steps = Reference(scenario.error_detector), lap_steps(scenario.error_detector)
    if math.isfinite(scenario.plant.duration):
        steps = min(steps, round(scenario.plant.duration / scenario.plant.ts))
    return [[round(value, 3) for value in reference[k][:2]] for k in range(0, steps + 1, max(1, steps // 400))]
