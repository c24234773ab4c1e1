"""The ROS package: colcon builds it in a clean workspace, and what it builds runs the loop."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
EXECUTABLES = ("plant", "relay", "error_detector", "controller", "recorder", "link_emulator")

# Another environment's Python that is started from one of the ROS wheels' must set itself up anew.
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}


def files_of_the_repository() -> list[str]:
    """What git knows or would add: a clean checkout with the changes of the moment."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.splitlines()
    return [name for name in listed if (REPOSITORY / name).is_file()]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with the package in it, built by colcon."""
    if shutil.which("colcon", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}") is None:
        pytest.skip("needs colcon: pip install colcon-common-extensions")
    root = tmp_path_factory.mktemp("workspace")
    for name in files_of_the_repository():
        target = root / "src/agv_ncs" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(REPOSITORY / name, target)
    assert colcon(root, "list").strip().endswith("(ros.ament_python)")
    colcon(root, "build", "--symlink-install", "--build-base", "linked_build", "--install-base", "linked")
    colcon(root, "build")
    return root


def colcon(root: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "colcon", *arguments],
        cwd=root, capture_output=True, text=True, env={**ENVIRONMENT, "COLCON_HOME": str(root)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("install", ["install", "linked"])
def test_executables_and_shared_files_lie_where_ros_looks_for_them(workspace: Path, install: str) -> None:
    prefix = workspace / install / "agv_ncs"
    for name in EXECUTABLES:
        assert os.access(prefix / "lib/agv_ncs" / name, os.X_OK)
    share = prefix / "share"
    assert (share / "ament_index/resource_index/packages/agv_ncs").is_file()
    for name in ("package.xml", "config/paper.yaml", "config/outages.yaml", "launch/loop.launch.py"):
        assert (share / "agv_ncs" / name).is_file()


def test_built_executables_run_a_lap_segment(workspace: Path, start: Callable[..., object], tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    from agv_analysis.recordings.recording import read_run

    prefix = workspace / "install/agv_ncs"
    site = next(prefix.glob("lib/python*/site-packages"))
    environment = {**ENVIRONMENT, "PYTHONPATH": str(site), "AMENT_PREFIX_PATH": str(prefix)}
    params = ["--params-file", str(prefix / "share/agv_ncs/config/outages.yaml")]

    def executable(name: str, *parameters: str) -> object:
        settings = [word for parameter in parameters for word in ("-p", parameter)]
        path = str(prefix / "lib/agv_ncs" / name)
        return start(path, "--ros-args", *params, *settings, env=environment, cwd=str(tmp_path))

    # In an order as unfortunate as can be: it does not matter.
    plant = executable("plant", "wait_for_subscribers:=2", "duration:=2.0")
    edge = [executable(name, "wait_for_subscribers:=2") for name in ("relay", "error_detector", "controller")]
    recorder = executable("recorder", f"bag:={tmp_path / 'bag'}", f"params_file:={params[1]}")
    status, said = plant.end()  # type: ignore[attr-defined]
    assert (status, "Traceback" in said) == (0, False), said
    for node in (*edge, recorder):
        node.process.send_signal(signal.SIGINT)  # type: ignore[attr-defined]
        status, said = node.end()  # type: ignore[attr-defined]
        assert (status, "Traceback" in said) == (0, False), said
    run = read_run(tmp_path / "bag")
    assert (len(run), dict(run.unexplained)) == (400, {})
    assert run.lost.any()


def launch(prefix: Path, tmp_path: Path, start: Callable[..., object], *arguments: str) -> object:
    """A process that launches the launch file, as `ros2 launch` does."""
    code = (
        "import sys\nfrom launch import LaunchDescription, LaunchService\n"
        "from launch.actions import IncludeLaunchDescription\n"
        "from launch.launch_description_sources import PythonLaunchDescriptionSource\n"
        "source = PythonLaunchDescriptionSource(sys.argv[1])\n"
        "arguments = [tuple(word.split(':=', 1)) for word in sys.argv[2:]]\n"
        "service = LaunchService()\n"
        "service.include_launch_description(\n"
        "    LaunchDescription([IncludeLaunchDescription(source, launch_arguments=arguments)]))\n"
        "sys.exit(service.run())\n"
    )
    environment = {
        **ENVIRONMENT, "AMENT_PREFIX_PATH": f"{prefix}{os.pathsep}{os.environ.get('AMENT_PREFIX_PATH', '')}",
        "PYTHONPATH": f"{next(prefix.glob('lib/python*/site-packages'))}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    }  # fmt: skip
    file = str(prefix / "share/agv_ncs/launch/loop.launch.py")
    return start(sys.executable, "-c", code, file, *arguments, env=environment, cwd=str(tmp_path))


def test_two_vehicles_by_the_launch_file_in_one_domain(
    workspace: Path, start: Callable[..., object], tmp_path: Path
) -> None:
    pytest.importorskip("launch_ros", reason="needs launch_ros, which comes with ROS 2")
    from agv_analysis.recordings.recording import read_run

    params = tmp_path / "params.yaml"
    params.write_text("/**/plant: {ros__parameters: {duration: 2.0}}", encoding="utf-8")
    prefix, names = workspace / "install/agv_ncs", ("agv_01", "agv_02")
    launched = [
        launch(prefix, tmp_path, start, f"params_file:={params}", f"bag:={tmp_path / name}", f"namespace:={name}")
        for name in names
    ]
    for process in launched:
        status, said = process.end(120.0)  # type: ignore[attr-defined]
        assert status == 0, said
        assert "everything that was published" in said
    for name in names:
        run = read_run(tmp_path / name)
        assert (len(run), dict(run.unexplained)) == (400, {})
        assert not [note for note in run.notes if "repeat" in note]


def test_a_launch_that_fails_says_so_by_its_status(
    workspace: Path, start: Callable[..., object], tmp_path: Path
) -> None:
    pytest.importorskip("launch_ros", reason="needs launch_ros, which comes with ROS 2")
    prefix = workspace / "install/agv_ncs"
    (tmp_path / "bag").mkdir()
    for arguments, reason in (
        (("params_file:=/no/such.yaml",), "params_file:=/no/such.yaml: there is no such file"),
        ((f"bag:={tmp_path / 'bag'}",), "exists"),
    ):
        status, said = launch(prefix, tmp_path, start, *arguments).end(120.0)  # type: ignore[attr-defined]
        assert status == 1, said
        assert reason in said
        assert "do they have the same ts" not in said


def test_versions_agree() -> None:
    in_package = ET.parse(REPOSITORY / "package.xml").findtext("version")
    in_setup = re.search(r'version="([^"]+)"', (REPOSITORY / "setup.py").read_text())
    assert in_setup is not None
    assert in_package == in_setup[1]
    assert f"## {in_package}" in (REPOSITORY / "CHANGELOG.md").read_text()


def test_package_xml_names_what_the_nodes_import() -> None:
    needed = {
        match
        for name in files_of_the_repository()
        if name.startswith("agv_") and name.endswith(".py")
        for match in re.findall(r"^(?:from|import) (\w+_msgs|rclpy)", (REPOSITORY / name).read_text(), re.MULTILINE)
    }
    root = ET.parse(REPOSITORY / "package.xml").getroot()
    named = {element.text for element in root.iter("exec_depend")}
    assert root.attrib["format"] == "3"
    assert needed <= named
    assert root.findtext("export/build_type") == "ament_python"
