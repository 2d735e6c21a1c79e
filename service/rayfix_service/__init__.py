"""The online half: a report and a table become a position, in Python (``fusion``) and over HTTP (``http``)."""

from pathlib import Path

from rayfix_tables.gaussians.kernel_cache import ensure_kernel_cache

ensure_kernel_cache(Path(__file__).parent)
