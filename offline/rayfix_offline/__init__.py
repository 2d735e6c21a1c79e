"""The offline half: builds a table from a site and its mesh, by rays and mixtures.

Its public interface is ``rayfix.build`` and the command line (see :mod:`rayfix`); modules may change without notice.
"""

from pathlib import Path

from rayfix_tables.gaussians.kernel_cache import ensure_kernel_cache

ensure_kernel_cache(Path(__file__).parent)
