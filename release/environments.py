"""`make lowest`, `make pythons`: the cheap tests in fresh environments, of other versions of packages and of Python."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]

TESTS = (
    "test/test_released_files.py",
    "test/test_config.py",
    "test/agv_ros/test_codec.py",
    "test/agv_plant/test_random_stream.py",
    "test/agv_cloud/test_tracking_error.py",
    "test/agv_analysis/metrics/test_outages.py",
)
"""Bags are read, the loop is simulated, messages are encoded; without ROS, and in a minute."""

TRIED = (
    ("simulate", "config/outages.yaml", "--set", "plant.duration=5.0", "--report", "{}/run.html",
     "--figures", "{}/run"),
    ("sweep", "config/paper.yaml", "--vary", "controller.kx=5:60:2", "--set", "plant.duration=5.0", "--out",
     "{}/sweep.parquet", "--format", "parquet", "--report", "{}/sweep.html"),
    ("bag", "export", "bags/sample", "--parquet", "--out", "{}/bag"),
    ("doctor", "--seconds", "0.2"),
)  # fmt: skip
"""Commands that use what extras bring: pictures, pages, Parquet."""

MADE = ("import agv_analysis.explore.app", "import distributed, dpkt, msgspec, lz4.frame, isal")
"""What has to be importable beside them: the explorer needs a person at a browser."""

TOOLS = ("pytest", "hypothesis", "mcap-ros2-support", "scipy", "ruff")

UV = (sys.executable, "-m", "uv", "pip")


def passes(python: str, resolution: str) -> bool:
    """Do the tests pass with a version of Python and packages as uv resolves them: `lowest-direct` or `highest`?"""
    with tempfile.TemporaryDirectory() as folder:
        packages, own = Path(folder) / "packages.txt", Path(folder) / "environment/bin/python"
        resolve = [*UV, "compile", "--quiet", "setup.py", "--extra", "all", "--resolution", resolution]
        subprocess.run(
            [*resolve, "--python-version", python, "--no-annotate", "--no-header", "--output-file", str(packages)],
            cwd=REPOSITORY, check=True,
        )  # fmt: skip
        sys.stdout.write(f"Python {python}, {resolution}: {' '.join(packages.read_text().split())}\n")
        subprocess.run([*UV[:-1], "venv", "--quiet", "--python", python, str(own.parents[1])], check=True)
        install = [*UV, "install", "--quiet", "--python", str(own)]
        subprocess.run([*install, "--requirement", str(packages), *TOOLS], check=True)
        subprocess.run(
            [*install, "--no-deps", str(REPOSITORY)], check=True
        )  # for its metadata; the tests take the sources
        tests = [str(own), "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "hypothesis.extra.pytestplugin"]
        environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        commands = [
            [str(own), "-m", "agv_analysis.cli", *(word.replace("{}", folder) for word in words)] for words in TRIED
        ]
        commands += [[str(own), "-c", code] for code in MADE]
        done = [subprocess.run([*tests, *TESTS], cwd=REPOSITORY, env=environment, check=False)]
        done += [subprocess.run(one, cwd=REPOSITORY, stdout=subprocess.DEVNULL, check=False) for one in commands]
        for one in done:
            if one.returncode:
                sys.stdout.write(f"failed: {' '.join(one.args)}\n")
        return not any(one.returncode for one in done)


def has(python: str) -> bool:
    """Can this version of Python be had here?"""
    return subprocess.run([*UV[:-1], "python", "find", python], capture_output=True, check=False).returncode == 0


def main(resolution: str, *pythons: str) -> None:
    """Try each version of Python that is here; ends with status 1 if one fails, or none is."""
    installed = map(str, Path("~/.pyenv/versions").expanduser().glob("*/bin"))
    os.environ["PATH"] = os.pathsep.join((os.environ["PATH"], *installed))  # where uv does not look by itself
    os.environ["UV_PYTHON_DOWNLOADS"] = "never"
    here = [python for python in pythons if has(python)]
    passed = {python: passes(python, resolution) for python in here}
    for python in pythons:
        said = {True: "passed", False: "failed", None: "not here"}[passed.get(python)]
        sys.stdout.write(f"Python {python}, {resolution}: {said}\n")
    raise SystemExit(0 if passed and all(passed.values()) else 1)


if __name__ == "__main__":
    main(*sys.argv[1:])
