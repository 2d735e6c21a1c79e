"""Python code in a process of its own, whose output a test reads as it comes."""

import re
import subprocess
import sys
import textwrap


class TalkingProcess:
    """A process that runs Python code.

    Attributes
    ----------
    process : subprocess.Popen
    said : str
        What it has printed, as far as it was read.
    """

    def __init__(self, code: str, *arguments: str) -> None:
        command = [sys.executable, "-c", textwrap.dedent(code), *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.said = ""

    def read(self, pattern: str) -> str:
        """Read on until a line matches a pattern; returns its group, or else the match."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said += line
            if found := re.search(pattern, line):
                return found[1] if found.groups() else found[0]
        raise AssertionError(f"no {pattern!r} in:\n{self.said}")
