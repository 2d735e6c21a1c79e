"""Ground truth and yardsticks: the forward solver, simulated reports, the position error bound."""

from pathlib import Path

from rayfix_tables.kernel_cache import ensure_kernel_cache

ensure_kernel_cache(Path(__file__).parent)
