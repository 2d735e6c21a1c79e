"""The paper's algorithms as published, on sampled points: the reference for rayfix's closed forms.

V. Corlay, V.-H. Nguyen, N. Gresset, "Fusion of Time and Angle Measurements for Digital-Twin-Aided Probabilistic 3D
Positioning". Nothing here is used to answer reports. ``docs/paper-method.md`` describes what follows the paper and what
had to be chosen.
"""
