"""The online half: a report and a table become a position, in Python (``fusion``) and over HTTP (``http``).

The public names are those that :mod:`rayfix` takes from here. The command line is public, too, and so is the HTTP
interface that docs/openapi.json describes; modules may change without notice.
"""

from pathlib import Path

from rayfix_tables.gaussians.kernel_cache import ensure_kernel_cache

ensure_kernel_cache(Path(__file__).parent)
