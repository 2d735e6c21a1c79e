"""Judging a site: simulated drops, bounds, baselines, the paper's method, planning maps, reports and pictures."""
