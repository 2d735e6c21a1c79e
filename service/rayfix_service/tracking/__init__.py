"""Targets followed over time: a particle filter per target that knows the building's walls; no web.

``motion`` is the model of the target's motion, ``walls`` what it cannot pass, ``likelihood`` what a report says of the
position, ``particles`` the filter's steps, ``estimate`` what is told of it, and ``tracker`` the store of all targets.
The words are those of Stone Soup: a track is predicted, updated and dropped.
"""
