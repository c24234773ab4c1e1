"""The version of the installed package."""

from agv_analysis.version import version

__version__ = version()
