"""The paper's algorithms as written, on sampled points: what rayfix's closed forms are measured against.

V. Corlay, V.-H. Nguyen, N. Gresset, "Fusion of Time and Angle Measurements for Digital-Twin-Aided Probabilistic 3D
Positioning". Nothing here is used to answer reports. ``docs/paper-method.md`` says what follows the paper and what had
to be chosen.
"""
