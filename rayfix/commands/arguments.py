"""What the commands' arguments share: how a command is added, values that are checked, options that several have."""

import argparse
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rayfix_service.adapters.omlox_hub import HubSettings

AddCommand = Callable[[str, Callable[[argparse.Namespace], int], str], argparse.ArgumentParser]
"""Makes a command of a name, what it runs, and what it does in words."""

_OUTPUTS = ("native", "3gpp", "omlox")
_HUB_VARIABLE = "RAYFIX_OMLOX_TOKEN"


def job_count(text: str) -> int:
    """Read a number of processes."""
    jobs = int(text)
    if jobs == 0 or jobs < -1:
        raise argparse.ArgumentTypeError(f"{jobs} is not a number of jobs; give 1 or more, or -1 for one per core")
    return jobs


def report_rate(text: str) -> float:
    """Read a number of reports a second."""
    rate = float(text)
    if not 0.0 < rate < 1e9:
        raise argparse.ArgumentTypeError(f"{text} is no rate; give a number of reports a second, e.g. 100")
    return rate


def drop_count(text: str) -> int:
    """Read a number of drops."""
    drops = int(text)
    if drops < 2:
        raise argparse.ArgumentTypeError(f"{drops} drops have no percentiles; give 2 or more")
    return drops


def seed_number(text: str) -> int:
    """Read a seed of random numbers."""
    seed = int(text)
    if seed < 0:
        raise argparse.ArgumentTypeError(f"{seed} is no seed; give 0 or more")
    return seed


def mass_share(text: str) -> float:
    """Read a share of a cell's mass."""
    tolerance = float(text)
    if not 0.0 <= tolerance < 1.0:
        raise argparse.ArgumentTypeError(f"{text} is no share; give 0 or more, below 1, e.g. 0.01")
    return tolerance


def add_output_arguments(command: argparse.ArgumentParser) -> None:
    """Add the options of how an answer is written, and of what the report leaves out."""
    command.add_argument("--output", choices=_OUTPUTS, default="native", help="format of the answer (default: native)")
    command.add_argument(
        "--station",
        action="append",
        default=[],
        metavar="NAME=STATION",
        help="the station that the report calls NAME; may be given several times",
    )
    command.add_argument(
        "--height",
        type=float,
        nargs=2,
        metavar=("Z", "STDEV"),
        help="known height of the target in the scene and its standard deviation, m",
    )


def add_hub_argument(command: argparse.ArgumentParser) -> None:
    """Add the option of commands that tell an omlox hub."""
    command.add_argument(
        "--omlox-hub",
        metavar="URL",
        help="also tell this omlox hub of all positions, e.g. http://hub:8081/v2; "
        f"a token is taken from the environment variable {_HUB_VARIABLE}",
    )


def hub_settings(options: argparse.Namespace) -> "HubSettings | None":
    """Return the hub that the options name, or None."""
    from rayfix_service.adapters.omlox_hub import HubSettings

    if options.omlox_hub is None:
        return None
    return HubSettings(url=options.omlox_hub, token=os.environ.get(_HUB_VARIABLE))
