"""An extension of Griffe (``mkdocs.yml``): Sphinx' roles in docstrings become code and links of mkdocstrings."""

import re
from typing import Any

from griffe import Extension, Object

_ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod|obj):`(~?)([^`<]+)`")
_DRAWING = re.compile(r"^::$", re.MULTILINE)


class Roles(Extension):
    """Rewrites every docstring once, as its object is read."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """``:class:`~rayfix.Fix``` becomes ``Fix``, in code."""
        if obj.docstring is not None:
            obj.docstring.value = in_markdown(obj.docstring.value)


def in_markdown(text: str) -> str:
    """Return a docstring with roles as code; a literal block begins without its mark."""
    return _DRAWING.sub("", _ROLE.sub(lambda found: f"`{shown(*found.groups())}`", text))


def shown(shortened: str, name: str) -> str:
    """Name as Sphinx shows it: after ``~`` its last part only."""
    return name.rpartition(".")[2] if shortened else name
