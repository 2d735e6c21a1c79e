"""Arguments of commands: adding a command, types that check values, and options of several commands."""

import argparse
import math
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from rayfix_service.adapters.omlox_hub import HubSettings

AddCommand = Callable[[str, Callable[[argparse.Namespace], int], str], argparse.ArgumentParser]
"""Adds a command, given its name, the function that it runs, and its help text."""

TABLE_SUFFIXES = (".h5", ".hdf5")
"""How names of tables end."""

_Number = TypeVar("_Number", int, float)

_OUTPUTS = ("native", "3gpp", "omlox")
_HUB_VARIABLE = "RAYFIX_OMLOX_TOKEN"


def job_count(text: str) -> int:
    """Read a number of processes."""
    return _number(
        text,
        int,
        lambda jobs: jobs == -1 or jobs >= 1,
        "is not a valid number of jobs; give 1 or more, or -1 for one per core",
    )


def report_rate(text: str) -> float:
    """Read a number of reports per second."""
    return _number(
        text, float, lambda rate: 0.0 < rate < 1e9, "is not a valid rate; give a number of reports per second, e.g. 100"
    )


def positive(text: str) -> float:
    """Read a limit."""
    return _number(text, float, lambda limit: 0.0 < limit < 1e9, "is not a valid limit; give a number above 0, e.g. 10")


def drop_count(text: str) -> int:
    """Read a number of drops; fewer than two have no percentiles."""
    return _number(text, int, lambda drops: drops >= 2, "is not a valid number of drops; give 2 or more")


def seed_number(text: str) -> int:
    """Read a seed of random numbers."""
    return _number(text, int, lambda seed: seed >= 0, "is not a valid seed; give an integer, 0 or more")


def mass_share(text: str) -> float:
    """Read a fraction of a cell's mass."""
    return _number(
        text, float, lambda share: 0.0 <= share < 1.0, "is not a fraction; give 0 or more, below 1, e.g. 0.01"
    )


def probability(text: str) -> float:
    """Read the probability that stated accuracies hold."""
    return _number(text, float, lambda p: 0.01 <= p <= 0.99, "is not a valid probability; give 0.01 to 0.99, e.g. 0.95")


def coordinate(text: str) -> float:
    """Read a coordinate."""
    return _number(text, float, math.isfinite, "is not a coordinate; give a number of metres")


def at_least_one(text: str) -> int:
    """Read an integer of 1 or more."""
    return _number(text, int, lambda number: 1 <= number < 1 << 31, "is not an integer of 1 or more")


def web_origin(text: str) -> str:
    """Read the origin of a web page, as browsers send it."""
    parts = urlsplit(text)
    whole = parts.scheme in ("http", "https") and parts.netloc and text == f"{parts.scheme}://{parts.netloc}"
    if text != "*" and not whole:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an origin; give scheme, host and port without a path, e.g. https://maps.example.com"
        )
    return text


def web_prefix(text: str) -> str:
    """Read the path below which a proxy offers the service; empty, as ``/`` is, for none."""
    from rayfix_service.http.access.prefix import is_prefix

    prefix = text.rstrip("/")
    if prefix and not is_prefix(prefix):  # argparse also reads the default, which is empty
        raise argparse.ArgumentTypeError(f"{text!r} is not a plain path; give e.g. /rayfix")
    return prefix


def _number(text: str, kind: Callable[[str], _Number], fits: Callable[[_Number], bool], otherwise: str) -> _Number:
    try:
        value = kind(text)
    except ValueError:
        pass
    else:
        if fits(value):
            return value
    raise argparse.ArgumentTypeError(f"{text!r} {otherwise}")


def add_jobs_argument(command: argparse.ArgumentParser, what: str) -> None:
    """Add the option for the number of parallel workers."""
    command.add_argument("--jobs", type=job_count, default=-1, metavar="N", help=f"{what} (default: one per core)")


def add_progress_argument(command: argparse.ArgumentParser) -> None:
    """Add the option of commands that show progress."""
    command.add_argument("--no-progress", action="store_true", help="show no progress bar")


def add_output_arguments(command: argparse.ArgumentParser) -> None:
    """Add the options for the output format and for data that the report does not contain."""
    command.add_argument("--output", choices=_OUTPUTS, default="native", help="format of the answer (default: native)")
    command.add_argument(
        "--station",
        action="append",
        default=[],
        metavar="NAME=STATION",
        help="the station with the name NAME in the report; may be given several times",
    )
    command.add_argument(
        "--height",
        type=float,
        nargs=2,
        metavar=("Z", "STDEV"),
        help="known height (z) of the target and its standard deviation, m",
    )


def add_confidence_argument(command: argparse.ArgumentParser) -> None:
    """Add the option for the probability that stated accuracies hold."""
    command.add_argument(
        "--confidence",
        type=probability,
        metavar="P",
        help="probability that the stated accuracies hold, 0.01 to 0.99 (default: the report's, or 0.68)",
    )


def add_hub_argument(command: argparse.ArgumentParser) -> None:
    """Add the options of commands that send positions to an omlox hub."""
    command.add_argument(
        "--omlox-hub",
        metavar="URL",
        help="also send all positions to this omlox hub, e.g. http://hub:8081/v2; "
        f"a token is taken from the environment variable {_HUB_VARIABLE}",
    )
    command.add_argument(
        "--hub-answer-kib",
        type=at_least_one,
        default=4,
        metavar="N",
        help="bytes of the hub's answer to read, KiB (default: 4)",
    )


def hub_settings(options: argparse.Namespace) -> "HubSettings | None":
    """Return the hub that the options name, or None."""
    from rayfix_service.adapters.omlox_hub import HubSettings

    if options.omlox_hub is None:
        return None
    token = os.environ.get(_HUB_VARIABLE)
    return HubSettings(url=options.omlox_hub, token=token, answer_bytes=options.hub_answer_kib << 10)
