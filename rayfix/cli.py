"""The command line. Every RayfixError is one line on standard error and exit status 2."""

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from rayfix.commands import building, calibrating, comparing, example, judging, locating, pictures, playing, serving
from rayfix_tables.errors import RayfixError
from rayfix_tables.version import software_version


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        self.exit(2, f"{self.prog}: {message}; see '{self.prog} --help'\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    options = make_parser().parse_args(arguments)
    try:
        return int(options.run(options))
    except RayfixError as error:
        print(f"rayfix: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("rayfix: interrupted; finished work is kept, run the same command again to go on", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    parser = _Parser(
        prog="rayfix",
        description="Indoor position fixes from angles and times of arrival.",
        epilog="'rayfix COMMAND --help' lists a command's options. To begin: rayfix demo",
    )
    parser.add_argument("--version", action="version", version=f"rayfix {software_version()}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)

    def add(name: str, run: Callable[[argparse.Namespace], int], text: str) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        command.set_defaults(run=run)
        return command

    for group in (example, building, locating, playing, pictures, serving, judging, calibrating, comparing):
        group.add_commands(add)
    return parser
