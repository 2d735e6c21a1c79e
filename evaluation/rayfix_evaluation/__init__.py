"""Judging a site: simulated drops, bounds, baselines, the paper's method, planning maps, reports and pictures.

Its public face is the command line (``rayfix evaluate``, ``plan``, ``plot``); all modules may change without notice.
"""
