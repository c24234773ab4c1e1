"""What tests share: a DDS domain of their own, and runs of the loop on real DDS, recorded to real bags."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import pytest

from test.command_runner import run_command

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

    from agv_analysis.run import Floats, Run

REPOSITORY = Path(__file__).parents[1]
DOMAINS = range(1, 102)  # those that Linux' ephemeral ports leave free
FIRST_PORT = 41000
_claims = itertools.count()


def _claim_domain() -> tuple[int, socket.socket]:
    """A DDS domain that no other test process has, held for as long as the socket is open.

    It is another one each time: in one that was used a moment ago, participants may be known that are gone.
    """
    begin = os.getpid() + 10 * next(_claims)
    for offset in DOMAINS:
        domain = DOMAINS[(begin + offset) % len(DOMAINS)]
        claim = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            claim.bind(("127.0.0.1", FIRST_PORT + domain))
        except OSError:
            claim.close()
        else:
            return domain, claim
    raise RuntimeError("every DDS domain is taken by another test process")


_LEFT_OUT: dict[str, str] = {}
"""Test files that need a package that is not installed, with its name."""


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out, where ROS' own packages are all there is, a file whose first lines import what only pip has."""
    if not collection_path.name.startswith("test_") or collection_path.suffix != ".py":
        return None
    names = re.findall(r"^(?:from|import) (\w+)", collection_path.read_text(encoding="utf-8"), re.MULTILINE)
    missing = [name for name in names if name in _ONLY_PIP and importlib.util.find_spec(name) is None]
    if missing:
        _LEFT_OUT[str(collection_path.relative_to(REPOSITORY))] = missing[0]
    return True if missing else None


_ONLY_PIP = ("mcap", "mcap_ros2", "rosbags", "lz4", "zstandard", "werkzeug")


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say what was left out."""
    for name, package in _LEFT_OUT.items():
        terminalreporter.write_line(f"LEFT OUT {name}: needs {package}: pip install '.[test]'")


# Set before any test imports rclpy: a context takes its domain from here, and so do the processes that tests start.
_domain, _claim = _claim_domain()
os.environ["ROS_DOMAIN_ID"] = str(_domain)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["PYTHONUNBUFFERED"] = "1"

# What a shell starts in the background ignores Ctrl-C, and so does all that it starts; here tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples every time, however busy the machine.
hypothesis.settings.register_profile(
    "agv_ncs", deadline=None, derandomize=True, database=None, max_examples=60,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],  # a busy machine is not a fault
)  # fmt: skip
hypothesis.settings.load_profile("agv_ncs")


@pytest.fixture(scope="session", autouse=True)
def _ros_home(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Logs of nodes go where the tests' other files go."""
    os.environ["ROS_HOME"] = str(tmp_path_factory.mktemp("ros_home"))


@pytest.fixture
def two_domains() -> Iterator[tuple[int, int]]:
    """Two more DDS domains that no other test process has."""
    claims = [_claim_domain() for _ in range(2)]
    yield claims[0][0], claims[1][0]
    for _, claim in claims:
        claim.close()


Lap = Callable[..., tuple["Floats", "Floats", "Floats"]]


@pytest.fixture(scope="session")
def lap() -> Lap:
    """Headings theta_r [rad] and speeds v_r [m/s], w_r [rad/s] of a track over a lap of `steps` steps of 5 ms."""

    def reference(track: str, steps: int = 20_000) -> tuple[Floats, Floats, Floats]:
        from agv_analysis.scenario import load_scenario
        from agv_cloud.reference.reference import Reference

        settings = [f"error_detector.track={track}", f"error_detector.lap_time={steps * 0.005}"]
        scenario = load_scenario(str(REPOSITORY / "config/paper.yaml"), settings)
        rows = Reference(scenario.error_detector).first(steps)
        return rows[:, 2], rows[:, 3], rows[:, 4]

    return reference


Drive = Callable[..., "Run"]


@pytest.fixture
def drive(tmp_path: Path) -> Drive:
    """Run a params file of config/ with settings on DDS, record it, and give the run that its bag holds."""

    def run(*settings: str, config: str = "paper", executor: str = "events", bag: Path | None = None) -> Run:
        from agv_analysis.recordings.recording import read_run
        from agv_analysis.runtime.runner import run_in_process
        from agv_analysis.scenario import load_scenario

        where = tmp_path / "bag" if bag is None else bag
        scenario = load_scenario(str(REPOSITORY / "config" / f"{config}.yaml"), settings)
        outcome = run_in_process(scenario, where, lambda _: None, executor)
        assert (outcome.failure, outcome.recording_failure) == ("", "")
        return read_run(where)

    return run


class Started:
    """A process of the project that a test has started."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.lines: list[str] = []

    def wait_for(self, text: str) -> str:
        """Read on until a line holds `text`; fails the test if the process ends before."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip("\n"))
            if text in line:
                return self.lines[-1]
        pytest.fail(f"ended without a line with {text!r}:\n" + "\n".join(self.lines))

    def until(self, condition: Callable[[], bool], seconds: float = 300.0) -> None:
        """Wait for something that it does elsewhere, in a file say; fails the test if the process ends before.

        `seconds` is only there so that a hanging test ends.
        """
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(0.05)
                pytest.fail("ended too early:\n" + self.end()[1])

    def children(self) -> list[Path]:
        """The processes that it has begun, from whichever thread, and that still run: their folders in Linux' /proc."""
        found: list[str] = []
        for begun in Path(f"/proc/{self.process.pid}/task").glob("*/children"):
            with contextlib.suppress(OSError):  # a thread may go while it is looked at
                found += begun.read_text().split()
        return [Path("/proc", child) for child in found]

    def end(self, seconds: float = 60.0) -> tuple[int, str]:
        """Exit status and all that was said; `seconds` is only there so that a hanging test ends."""
        rest, _ = self.process.communicate(timeout=seconds)
        return self.process.returncode, "\n".join([*self.lines, *rest.splitlines()])


Start = Callable[..., Started]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a module of the project or an executable in a process of its own; it is ended with the test."""
    started: list[Started] = []

    def run(*command: str, **options: Any) -> Started:
        arguments = list(command) if command[0].startswith("/") else [sys.executable, "-m", *command]
        process = subprocess.Popen(
            arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **({"cwd": REPOSITORY} | options)
        )
        started.append(Started(process))
        return started[-1]

    yield run
    for child in started:
        if child.process.poll() is None:
            child.process.terminate()
    for child in started:
        try:
            child.process.communicate(timeout=30.0)
        except subprocess.TimeoutExpired:  # it would answer the nodes of the tests to come
            child.process.kill()
            child.process.communicate()
            pytest.fail(f"did not end when it was asked to: {child.process.args!r}")


NO_ROS = """
import re, sys

class NoRos:
    def find_spec(self, name, path=None, target=None):
        if re.match(r"(rclpy|\\w+_msgs|\\w+_interfaces|(rosidl|ament|rmw|rosbag2|launch_ros)\\w*)(\\.|$)", name):
            raise ModuleNotFoundError(f"no ROS here: {name}", name=name)

sys.meta_path.insert(0, NoRos())
sys.argv = sys.argv[1:]
"""

Code = Callable[..., str]


@pytest.fixture(scope="session")
def without_ros() -> Code:
    """Run Python code in a process in which ROS cannot be imported; gives what it printed, fails if it fails."""

    def run(code: str, *arguments: object, cwd: Path = REPOSITORY, path: Path | None = None) -> str:
        folders = [str(REPOSITORY), *([str(path)] if path else [])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders), "MPLBACKEND": "agg"}
        done = subprocess.run(
            [sys.executable, "-c", NO_ROS + code, *map(str, arguments)],
            cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=600,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout
        return done.stdout

    return run


AgvNcs = Callable[..., tuple[int, str]]


@pytest.fixture
def agv_ncs(start: Start, monkeypatch: pytest.MonkeyPatch) -> AgvNcs:
    """Run a command of `agv-ncs` to its end: exit status and output.

    It runs in this process; with an environment `env` in one that has it, which a test's other commands share.
    """
    others: list[tuple[dict[str, str], Started]] = []

    def run(*arguments: object, env: dict[str, str] | None = None) -> tuple[int, str]:
        words = list(map(str, arguments))
        if env is None:
            monkeypatch.chdir(REPOSITORY)
            return run_command(words)
        other = next((started for known, started in others if known == env), None)
        if other is None:
            other = start(sys.executable, "test/command_runner.py", env=env, stdin=subprocess.PIPE)
            others.append((dict(env), other))
        assert other.process.stdin is not None
        print(json.dumps(words), file=other.process.stdin, flush=True)
        status, said = json.loads(other.wait_for("done: ").partition("done: ")[2])
        return status, said

    return run


Install = Callable[..., dict[str, str]]


@pytest.fixture(scope="session")
def install() -> Install:
    """Put a package into a folder as pip would; gives the environment of processes that have it.

    `modules` are sources by name, `points` the entry points by group, each a name and what it names.
    """

    def into(folder: Path, modules: dict[str, str], points: dict[str, dict[str, str]], name: str = "foreign") -> Any:
        information = folder / f"{name}-1.0.dist-info"
        information.mkdir(parents=True)
        for module, code in modules.items():
            (folder / f"{module}.py").write_text(code, encoding="utf-8")
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        groups = (f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in named.items()) for group, named in points.items())
        (information / "entry_points.txt").write_text("\n".join(groups), encoding="utf-8")
        return {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{REPOSITORY}", "COLUMNS": "200"}

    return into


@pytest.fixture(scope="session")
def page_block() -> Callable[[str, str], str]:
    """The code between two marks of a page of docs/."""

    def block(page: str, mark: str) -> str:
        text = (REPOSITORY / "docs" / page).read_text(encoding="utf-8")
        found = re.search(rf"<!-- {mark}:begin -->\n```\w+\n(.*?)```\n<!-- {mark}:end -->", text, re.DOTALL)
        assert found, f"{page} has no block {mark}"
        return found.group(1)

    return block


@pytest.fixture(scope="session")
def chromium() -> Iterator[Chrome]:
    """Headless Chromium, Debian's, one for all tests of a process; its log is emptied before each page."""
    pytest.importorskip("selenium", reason="needs selenium: pip install '.[test]'")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("needs Chromium and its driver: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "enable-unsafe-swiftshader"):
        options.add_argument(f"--{argument}")
    options.add_argument("--window-size=1100,1400")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chrome = webdriver.Chrome(options=options, service=Service(driver))
    chrome.set_page_load_timeout(120.0)
    yield chrome
    chrome.quit()


@pytest.fixture
def two_hosts() -> Iterator[tuple[list[str], list[str]]]:
    """Commands' beginnings that run them on two hosts, which are network namespaces joined by a cable."""
    if shutil.which("ip") is None or os.geteuid() != 0:
        pytest.skip("two network namespaces need root and iproute2")
    names = [f"agv_ncs_{os.getpid()}_{side}" for side in ("agv", "edge")]
    ends = [f"v{os.getpid()}{side}" for side in "ae"]

    def ip(*arguments: str) -> None:
        subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)

    try:
        try:
            for name in names:
                ip("netns", "add", name)
            ip("link", "add", ends[0], "netns", names[0], "type", "veth", "peer", "name", ends[1], "netns", names[1])
            for host, (name, end) in enumerate(zip(names, ends, strict=True), start=1):
                ip("-n", name, "address", "add", f"10.213.0.{host}/24", "dev", end)
                for link in ("lo", end):
                    ip("-n", name, "link", "set", link, "up")
                ip("-n", name, "route", "add", "default", "dev", end)  # where multicast goes
        except subprocess.CalledProcessError as error:
            pytest.skip(f"this machine allows no network namespaces: {error.stderr.strip()}")
        yield ["ip", "netns", "exec", names[0]], ["ip", "netns", "exec", names[1]]
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], check=False, capture_output=True)
