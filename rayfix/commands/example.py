"""The bundled examples: ``rayfix demo`` and ``rayfix example``."""

import argparse
from pathlib import Path
from typing import Literal

from rayfix.commands.arguments import AddCommand, add_jobs_argument
from rayfix.extras import needs_extra
from rayfix.own_command import own_command

_EXAMPLES: tuple[Literal["hall", "office"], ...] = ("hall", "office")


def add_commands(add: AddCommand) -> None:
    """Add the commands to the command line."""
    demo = add("demo", _demo, "build, serve and locate in the bundled hall, and draw a picture of the fix")
    demo.add_argument("-o", "--output", type=Path, default=Path("demo"), metavar="DIR", help="folder (default: demo)")
    add_jobs_argument(demo, "cells fitted at a time")

    example = add("example", _example, "write a bundled example: its scene (glb), site.toml, report.json")
    example.add_argument(
        "example",
        nargs="?",
        choices=_EXAMPLES,
        help="a hall full of machines, or an office whose walls let signals through (default: the one that the folder "
        "is named after, or the hall)",
    )
    example.add_argument("folder", type=Path, metavar="DIR", help="folder, created if necessary")


def _demo(options: argparse.Namespace) -> int:
    with needs_extra("all"):
        from rayfix.demo import run_demo
    run_demo(options.output, jobs=options.jobs)
    return 0


def _example(options: argparse.Namespace) -> int:
    with needs_extra("offline"):
        from rayfix.example.files import write_example

        named = next((name for name in _EXAMPLES if name == options.folder.name), _EXAMPLES[0])
        example = options.example or named
        site = write_example(options.folder, example=example)
    table = options.folder / f"{example}.h5"
    print(f"Wrote {site} with its scene and a report. Next: {own_command()} build {site} -o {table}")
    return 0
