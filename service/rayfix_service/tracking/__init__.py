"""Targets followed over time: a particle filter per target that knows the building's walls; no web.

``motion`` is the model of the target's motion, ``walls`` what it cannot pass, ``likelihood`` that of a report,
``particles`` the filter's steps, ``estimate`` the summary of the particles, and ``tracker`` the store of all targets.
The terms are those of Stone Soup: a track is predicted, updated and dropped.
"""
