"""The command line `agv-ncs`: one module of `commands` for each command.

Only click is imported at start; a command is imported when it is asked for, and imports what it needs when it runs, so
that `--help` and errors come at once and analysis works where there is no ROS.
"""

from __future__ import annotations

import importlib
import logging
import sys
from typing import Any

import click

COMMANDS = (
    "run", "analyse", "stability", "channel", "link", "probe", "require", "parameters", "simulate", "explore", "sweep",
    "bag", "replay", "reproduce", "node", "doctor", "watch", "identify",
)  # fmt: skip


class _Group(click.Group):
    """Finds commands by name; what is wrong with a request is one line and exit status 1, never a traceback."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = importlib.import_module(f"agv_analysis.commands.{cmd_name}").command
        return command

    def invoke(self, ctx: click.Context) -> Any:
        from agv_ros.errors import UserError
        from agv_ros.printable import printable

        _announce_compilation()
        try:
            return super().invoke(ctx)
        except OSError as error:  # of a path that no one has thought of, as one that is too long
            if error.filename is None:
                raise
            raise click.ClickException(printable(f"{error.filename}: {error.strerror}")) from None
        except ModuleNotFoundError as error:
            from agv_analysis.doctor.extras import extra_with

            missing = (error.name or "").partition(".")[0]
            if (extra := extra_with(missing)) is None:
                raise
            said = f"this needs {missing}, which is not installed: pip install 'agv_ncs[{extra}]'"
            raise click.ClickException(said) from None
        except UserError as error:
            raise click.ClickException(printable(str(error))) from None


class _OnceToTerminal(logging.Handler):
    """Says at a terminal, the first time that something is compiled, why a command takes so long."""

    def emit(self, record: logging.LogRecord) -> None:
        log = logging.getLogger(record.name)
        log.removeHandler(self)
        if sys.stderr.isatty():
            click.echo("note: compiles the loop, once for this version: some seconds", err=True)


def _announce_compilation() -> None:
    log = logging.getLogger("agv_analysis.compiled.functions")
    log.setLevel(logging.INFO)
    log.propagate = False
    log.handlers[:] = [_OnceToTerminal()]


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120})
@click.version_option(package_name="agv_ncs")
def main() -> None:
    """Close an AGV's control loop over a lossy radio link, record it, and learn whether it is stable.

    \b
    Examples:
      agv-ncs run config/outages.yaml --bag bags/first
      agv-ncs run config/paper.yaml --set controller.kx=250.0 --set controller.v_max=6.0 --bag bags/fast
      agv-ncs analyse bags/first --json first.json
    """


if __name__ == "__main__":
    main()
