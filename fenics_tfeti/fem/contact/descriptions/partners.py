"""Ways in which pairs of nodes are found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from numpy.typing import ArrayLike

from fenics_tfeti.errors import InputError, check_value
from fenics_tfeti.fem.user_data import (
    VectorField,
    as_direction,
    as_points,
    check_field,
    check_positive,
    is_function,
)
from fenics_tfeti.typing import Vector


@dataclass(frozen=True)
class Nearest:
    """Conditions between each slave node and the nearest master node.

    Attributes
    ----------
    tolerance : float
        Largest distance of the two along the surface, relative to the mean edge of the smallest of
        the slave's facets there.

    Examples
    --------
    >>> Nearest(tolerance=0.3)
    Nearest(tolerance=0.3)
    """

    tolerance: float = 0.1

    def __post_init__(self) -> None:
        _check_tolerance(self)


@dataclass(frozen=True)
class Along:
    """Conditions between each slave node and a master node on a line through it.

    Attributes
    ----------
    direction : (gdim,) array-like or callable
        Direction of the line, of any length and either sense; a callable gets x (3, n) [m] and
        returns (gdim, n). Of the master nodes on the line, those are candidates whose normals point
        against the slave node's.
    tolerance : float
        Largest distance of the master node from the line, relative to the mean edge of the smallest
        of the slave's facets there.

    Examples
    --------
    >>> Along((0, 0, 1))
    Along(direction=(0, 0, 1), tolerance=0.1)
    """

    direction: VectorField
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        check_field(self.direction, "Along: the direction", as_direction)
        _check_tolerance(self)


@dataclass(frozen=True)
class Mapped:
    """Conditions between each slave node and the master node nearest to its image.

    Attributes
    ----------
    mapping : callable
        chi of sec. 11.1: x (3, n) -> (3, n), the expected places of the slave nodes' partners [m].
    tolerance : float
        Largest distance of the master node from the image, relative to the mean edge of the
        smallest of the slave's facets there.

    Examples
    --------
    The partners of the nodes at x = 1 are at x = 3.

    >>> import numpy as np
    >>> shift = Mapped(lambda x: x + np.array([[2.0], [0.0], [0.0]]))
    >>> shift.mapping(np.array([[1.0], [0.5], [0.0]])).ravel().tolist()
    [3.0, 0.5, 0.0]
    """

    mapping: Callable[[Vector], ArrayLike]
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        what, expected = "Mapped: the mapping", "a function x (3, n) -> (3, n)"
        check_value(is_function(self.mapping, what), what, self.mapping, expected)
        _check_tolerance(self)


@dataclass(frozen=True, eq=False)
class Points:
    """Conditions between pairs of nodes at given places, the same on all ranks.

    Attributes
    ----------
    slave, master : (k, gdim) or (k, 3) array-like
        Coordinates of the slave node and of the master node of each pair [m].
    tolerance : float
        Largest distance of the nodes from these places, relative to the mean edge of the smallest
        of the facets there.

    Examples
    --------
    >>> pairs = Points(slave=[(0, 1), (1, 1)], master=[(0, 1), (1.02, 1)])
    >>> ContactPair(facet_tags, 5, 6, partners=pairs)  # doctest: +SKIP
    """

    slave: ArrayLike
    master: ArrayLike
    tolerance: float = 0.1

    def __post_init__(self) -> None:
        slave = as_points(self.slave, "Points: the slave points")
        master = as_points(self.master, "Points: the master points")
        if len(slave) != len(master):
            raise InputError(
                f"Points: {len(slave)} slave points and {len(master)} master points are given; "
                "give one master point for each slave point"
            )
        _check_tolerance(self)


@dataclass(frozen=True)
class Mortar:
    """Mortar conditions: weighted means over facets, also where the meshes match.

    Examples
    --------
    >>> ContactPair(facet_tags, 5, 6, partners=Mortar())  # doctest: +SKIP
    """


NodePartners: TypeAlias = Nearest | Along | Mapped | Points


def _check_tolerance(partners: NodePartners) -> None:
    what = f"{type(partners).__name__}: the tolerance"
    check_positive(partners.tolerance, what, "the size of the slave's facets")
