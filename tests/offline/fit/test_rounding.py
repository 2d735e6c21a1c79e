"""What rounding leaves of zeros does not come into a table: it differs from one version of NumPy to the next."""

import numpy as np

from rayfix_offline.fit.tubes import Labels, joint_to_tubes
from rayfix_tables.mixture import FIELD_SHAPES

FLOOR = 0.002  # m


def test_the_last_bits_of_moments_change_no_tube() -> None:
    """Tubes along the axes, whose covariances have zeros off the diagonal."""
    rng = np.random.default_rng(1)
    count = 200
    mean = np.column_stack([rng.uniform(3.0, 30.0, count), np.zeros((count, 2)), rng.uniform(-9.0, 9.0, (count, 3))])
    u_cov = np.zeros((count, 3, 3))
    u_cov[:, range(3), range(3)] = rng.uniform(0.01, 1.0, (count, 3))
    jacobian = np.zeros((count, 3, 3))
    jacobian[:, range(3), range(3)] = np.column_stack([np.ones(count), mean[:, 0], mean[:, 0]])
    cov = np.zeros((count, 6, 6))
    cov[:, :3, :3], cov[:, 3:, :3] = u_cov, jacobian @ u_cov
    cov[:, :3, 3:] = cov[:, 3:, :3].transpose(0, 2, 1)
    cov[:, 3:, 3:] = jacobian @ u_cov @ jacobian.transpose(0, 2, 1) + 50.0 * np.eye(3)
    noise = rng.normal(0.0, 1e-17, cov[:, 3:, 3:].shape)
    other = cov.copy()
    other[:, 3:, 3:] += noise + noise.transpose(0, 2, 1)
    labels = Labels(np.zeros(count, np.int8), np.zeros(count, np.int8))
    exact, noisy = (
        joint_to_tubes(np.zeros(count), mean, each, labels, position_floor=FLOOR).as_stored() for each in (cov, other)
    )
    for name in FIELD_SHAPES:
        assert getattr(exact, name).tobytes() == getattr(noisy, name).tobytes(), name
    off_diagonal = exact.x_cov[:, [1, 2, 4]]
    assert not off_diagonal.any()
    assert not np.signbit(off_diagonal).any()
