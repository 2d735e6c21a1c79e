"""Evaluation of a site: simulated drops, bounds, baselines, the paper's method, planning maps, reports and pictures.

Its public interface is the command line (``rayfix evaluate``, ``plan``, ``plot``). All modules may change without
notice.
"""

from pathlib import Path

from rayfix_tables.gaussians.kernel_cache import ensure_kernel_cache

ensure_kernel_cache(Path(__file__).parent)
