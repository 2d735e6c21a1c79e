"""Which paths there are: one notion for the access control, the short way and the router.

A path that could mean one thing to one of them and another to the next is refused before any of them sees it. What is
not open needs a key, so that a path that nobody thought of is closed.
"""

import re

_OPEN = frozenset({"/", "/docs", "/openapi.json", "/livez", "/readyz"})
_OPEN_FOLDERS = ("/assets/", "/interface/")

# Control characters and line ends, what UTF-8 could not read, backslashes, empty segments, "." and "..".
_ODD = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ufffd\ud800-\udfff\\\\]|//|/\\.{1,2}(?:/|\\Z)|\\A(?!/)")

_PLAIN = re.compile("(?:/[A-Za-z0-9_-]+)+")  # nearly every path; this takes less time


def is_odd(path: str) -> bool:
    """Tell whether a decoded path is none that this service answers, whatever its routes are."""
    return _PLAIN.fullmatch(path) is None and _ODD.search(path) is not None


def is_open(path: str) -> bool:
    """Tell whether a path, which is not odd, is answered without a key."""
    return path in _OPEN or path.startswith(_OPEN_FOLDERS)
