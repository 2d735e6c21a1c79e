"""Blocks of code in the documentation: where they are, what they are, and whether tests run them.

A block is run unless a comment before it says why not::

    <!-- not run: needs a Kubernetes cluster -->
    ```sh
    helm install ...

Words after the language say more: ``file=hall/site.toml`` is written there for later blocks of the page,
``input=nrppa`` and ``output=omlox`` are messages of other systems, ``schema=TrackDocument`` is of that name in
``docs/openapi.json``.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from tests.support.checkout import ROOT

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
"""Every page whose blocks are held to these rules."""

_NOT_RUN = re.compile(r"<!-- not run: (.+) -->")
_OPENING = re.compile(r"( *)```(\w*) ?(.*)")


@dataclass(frozen=True, kw_only=True)
class Block:
    """One fenced block.

    Attributes
    ----------
    page : Path
    line : int
        Of its opening fence, from 1.
    language : str
        First word behind the fence; may be empty.
    words : dict
        ``name=value`` behind the language.
    reason : str or None
        Why tests do not run it; None where they do.
    text : str
    """

    page: Path
    line: int
    language: str
    words: dict[str, str]
    reason: str | None
    text: str

    def __str__(self) -> str:
        """Where it is, for messages."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks_of(page: Path, text: str | None = None) -> list[Block]:
    """Return the fenced blocks of a page in turn.

    Raises
    ------
    ValueError
        When code is indented instead of fenced, or a fence is not closed.
    """
    lines = (page.read_text(encoding="utf-8") if text is None else text).split("\n")
    blocks, number = [], 0
    while number < len(lines):
        opening = _OPENING.fullmatch(lines[number])
        if opening is None:
            if lines[number].startswith("    ") and number and not lines[number - 1]:
                raise ValueError(f"{page.name}:{number + 1}: write code between fences, with its language")
            number += 1
            continue
        indent, language, words = opening.groups()
        try:
            end = lines.index(f"{indent}```", number + 1)
        except ValueError:
            raise ValueError(f"{page.name}:{number + 1}: this fence is not closed") from None
        mark = _NOT_RUN.fullmatch(lines[number - 1].strip()) if number else None
        blocks.append(
            Block(
                page=page,
                line=number + 1,
                language=language,
                words=dict(word.split("=", 1) for word in words.split()),
                reason=mark and mark[1],
                text="\n".join(line.removeprefix(indent) for line in lines[number + 1 : end]) + "\n",
            )
        )
        number = end + 1
    return blocks


def commands_of(text: str) -> list[str]:
    """Return the commands of a shell block, without comments, each on one line."""
    joined = re.sub(r"\\\n\s*", "", text)
    without = (re.sub(r"(^|\s+)#(?!\{).*", "", line).strip() for line in joined.split("\n"))
    return [line for line in without if line]
