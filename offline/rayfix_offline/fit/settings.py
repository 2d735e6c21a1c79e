"""Numbers that decide the mixtures of cells."""

from dataclasses import dataclass

from rayfix_tables.level import WINDOW_RATIO


@dataclass(frozen=True, kw_only=True)
class RayFit:
    """What all fits to rays have in common.

    Attributes
    ----------
    cutoff : float
        A cell uses the rays within this many standard deviations of its window.
    position_floor : float, m
        Smallest standard deviation of a component across its tube.
    length_floor : float, m
        Smallest standard deviation of a component along its tube.
    """

    cutoff: float = 3.0
    position_floor: float = 0.002
    length_floor: float = 0.05


@dataclass(frozen=True, kw_only=True)
class TubeFit(RayFit):
    """Settings of ``fit = "tubes"``.

    Attributes
    ----------
    dropped_mass : float
        Largest fraction of a cell's mass that is dropped with its lightest groups.
    max_groups : int
        Largest number of groups of a cell that are used, the heaviest first.
    max_components : int
        Largest number of components of a cell.
    max_divergence : float
        Largest divergence of a merge, nats.
    """

    dropped_mass: float = 1e-5
    max_groups: int = 250
    max_components: int = 48
    max_divergence: float = 1e-2


@dataclass(frozen=True, kw_only=True)
class ExpectationMaximisation(RayFit):
    """Settings of ``fit = "em"``.

    Attributes
    ----------
    num_points : int
        Points drawn for a cell.
    num_components : tuple of int
        Numbers of components among which BIC chooses.
    seed : int
        Each cell draws with the seed (seed, cell).
    max_rounds : int
        Largest number of rounds of a fit.
    regularisation : float
        Added to the variances of the scaled points.
    min_scale : float, m or rad
        Smallest standard deviation by which points are scaled.
    min_weight : float
        Smallest weight of a component.
    """

    num_points: int = 3000
    num_components: tuple[int, ...] = (4, 8, 16)
    seed: int = 1
    max_rounds: int = 200
    regularisation: float = 1e-6
    min_scale: float = 1e-6
    min_weight: float = 1e-12


@dataclass(frozen=True, kw_only=True)
class CoarseFit:
    """Settings of the cells of wide windows, which are sums of finer cells.

    Attributes
    ----------
    reach : float
        Finer cells within this many standard deviations are summed.
    max_divergence : float
        Largest divergence of a merge under the noise of measurements, nats.
    noise_share : float
        The noise of angles is this fraction of the smallest for which the wide window is used.
    range_stdev : float, m
        Standard deviation of the noise of path lengths.
    window_ratio : float
        A window's standard deviation is at least this times that of the measurements that it is used for.
    length_stretch : float
        Boxes of the tree may be this many times as long as wide, because tubes are straight along their length.
    min_length : float, m
        Smallest mean path length for the size of the boxes.
    position_floor : float, m
        See :class:`RayFit`.
    """

    reach: float = 3.0
    max_divergence: float = 1e-2
    noise_share: float = 0.5
    range_stdev: float = 0.1
    window_ratio: float = WINDOW_RATIO
    length_stretch: float = 2.5
    min_length: float = 1e-3
    position_floor: float = RayFit.position_floor


@dataclass(frozen=True, kw_only=True)
class BalanceSettings:
    """Settings of the normalisation of path probabilities; see :mod:`rayfix_offline.fit.normalise`.

    Attributes
    ----------
    rounds : int
        Number of rounds.
    max_factor : float
        Largest factor by which a round changes the value of a block.
    block_size : float, m
        Side of the blocks in which probabilities are summed, unless voxels are larger.
    num_points : int
        Points that represent a component.
    thickness : float, m2
        Added to the variances of a component's position.
    window_ratio : float
        A window's standard deviation is at least this times that of the measurements that it is used for.
    """

    rounds: int = 3
    max_factor: float = 2.0
    block_size: float = 0.2
    num_points: int = 64
    thickness: float = 1e-6
    window_ratio: float = WINDOW_RATIO
