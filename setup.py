"""One set-up for pip and for colcon (ament_python)."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "agv_ncs"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="An AGV's control loop over a lossy radio link on ROS 2: run it, record it, learn whether it is stable",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="The agv_ncs developers",
    maintainer="The agv_ncs developers",
    maintainer_email="agv_ncs@example.org",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=find_packages(include=["agv_ros*", "agv_plant*", "agv_cloud*", "agv_analysis*", "agv_ncs*"]),
    package_data={
        **{package: ["py.typed"] for package in ("agv_ros", "agv_plant", "agv_cloud", "agv_analysis", "agv_ncs")},
        "agv_analysis.report": ["*.j2"],
        "agv_analysis.requirements": ["*.yaml"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(map(str, Path("config").iterdir()))),
        (f"share/{PACKAGE}/launch", sorted(map(str, Path("launch").glob("*.launch.py")))),
    ],
    install_requires=[
        "setuptools",
        "click>=8.1",
        "isal>=1.1",
        "jinja2>=3.0",
        "matplotlib>=3.6",
        "lz4>=4.0",
        "mcap>=1.6",
        "numba>=0.57",
        "numpy>=1.23",
        "packaging>=22.0",
        "plotly>=6.0",
        "pyyaml>=6.0",
        "rich>=12.0",
        "rosbags>=0.10",
        "zstandard>=0.18",
    ],
    extras_require={
        # ROS 2 Jazzy's rclpy with Fast DDS from PyPI, for machines where no ROS is installed.
        "ros": ["ros-jazzy-rclpy>=7.1.6", "ros-rclpy[fastrtps]>=7.1.6", "ros-jazzy-common-interfaces>=5.3.6"],
        # The page of `agv-ncs explore`.
        "explore": ["dash>=3.0"],
        # Sweeps on a Dask cluster, and results as Parquet.
        "cluster": ["distributed>=2023.1"],
        "parquet": ["pyarrow>=12.0"],
        # Captures of packets as measured links.
        "captures": ["dpkt>=1.9"],
        # irtt's JSON at several times the speed.
        "irtt": ["msgspec>=0.18"],
        "test": [
            "colcon-common-extensions",
            "dash>=3.0",
            "distributed>=2023.1",
            "dpkt>=1.9",
            "hypothesis>=6.80",
            "mcap-ros2-support>=0.5",
            "msgspec>=0.18",
            "mypy>=1.10",
            "pandas>=2.0",
            "polars>=1.0",
            "pyarrow>=12.0",
            "pypdfium2>=4.0",
            "pytest>=7.4",
            "pytest-cov>=4.1",
            "pytest-xdist>=3.3",
            "ruff>=0.6",
            "scipy>=1.9",
            "selenium>=4.11",
            "types-PyYAML",
        ],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "agv-ncs = agv_analysis.cli:main",
            "plant = agv_plant.plant_node:main",
            "relay = agv_plant.relay_node:main",
            "error_detector = agv_cloud.error_detector_node:main",
            "controller = agv_cloud.controller_node:main",
            "recorder = agv_analysis.runtime.recorder_node:main",
        ],
    },
)
