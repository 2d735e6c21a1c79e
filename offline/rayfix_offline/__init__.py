"""The offline half: a site and its mesh become rays, mixtures and a table.

Its public face is ``rayfix.build`` and the command line (see :mod:`rayfix`); all modules may change without notice.
"""

from pathlib import Path

from rayfix_tables.gaussians.kernel_cache import ensure_kernel_cache

ensure_kernel_cache(Path(__file__).parent)
