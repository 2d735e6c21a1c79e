"""Ground truth and yardsticks: the forward solver, simulated reports, the position error bound."""
