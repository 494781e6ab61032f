"""Rigid bodies that contacts, loads, springs and prescribed motions move."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.contact.descriptions.surfaces import checked_label
from fenics_tfeti.fem.tolerances import RELATIVE_ROUNDING
from fenics_tfeti.fem.user_data import as_coordinates, is_number
from fenics_tfeti.typing import Mask, Vector

# a number for each component or one for all; or a dolfinx Constant, read by each solve
Components: TypeAlias = Any


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A rigid body that forces move: the `body` of obstacles, or cells of the mesh.

    Its shape is that of the obstacles and cells, where nothing has moved it. The same object in
    several places is one body.

    Attributes
    ----------
    reference : (gdim,) array-like
        The point that translations, rotations, moments and springs refer to [m].
    force : (gdim,) array-like or dolfinx.fem.Constant
        Force on the body, at the reference point [N], beside that of forms on its cells.
    moment : (3,) array-like, in 2D a number, or dolfinx.fem.Constant
        Moment on the body [N m].
    translation, rotation : sequence, number, dolfinx.fem.Constant or None
        Prescribed components of the motion, None where it is free: ``translation=(0, 0, None)`` is
        a slide along z. A number is for all components. In 2D the rotation is a number. Angles are
        in [rad], and small where they are not corrected by ``gaps=Deformed()``. By default the
        body is free.
    spring : array-like, optional
        Stiffness of a support: numbers for the components of the translation [N/m], or of
        translation and rotation [N m], or a symmetric matrix of all components.
    name : str
        For messages and results.

    Examples
    --------
    >>> punch = RigidBody((0.0, 0.0, 1.0), force=(0.0, 0.0, -1e3), rotation=0.0)
    >>> punch.is_free.tolist()
    [True, True, True, False, False, False]
    """

    reference: ArrayLike
    _: KW_ONLY
    force: Components = 0.0
    moment: Components = 0.0
    translation: Components = None
    rotation: Components = None
    spring: ArrayLike | None = None
    name: str = ""

    def __post_init__(self) -> None:
        as_coordinates(self.reference, f"{checked_label(self)}: the reference point")
        _ = self.load, self.prescribed_motion, self.stiffness

    @property
    def _label(self) -> str:
        return self.name or "RigidBody"

    @property
    def point(self) -> Vector:
        """The reference point (gdim,) [m]."""
        return np.asarray(self.reference, dtype=float)

    @property
    def gdim(self) -> int:
        """2 or 3."""
        return self.point.size

    @property
    def modes(self) -> int:
        """Number of components of a motion."""
        return 3 if self.gdim == 2 else 6

    @property
    def load(self) -> Vector:
        """Force and moment now (modes,)."""
        return np.append(
            self._components("force", self.gdim), self._components("moment", self.modes - self.gdim)
        )

    @property
    def is_free(self) -> Mask:
        """Which components of the motion are not prescribed (modes,)."""
        return np.isnan(self._motion)

    @property
    def prescribed_motion(self) -> Vector:
        """The prescribed components of the motion now, zero where it is free (modes,)."""
        return np.nan_to_num(self._motion, nan=0.0)

    @property
    def stiffness(self) -> Vector:
        """The stiffness of the spring (modes, modes)."""
        C = np.zeros((self.modes, self.modes))
        if self.spring is None:
            return C
        try:
            given = np.asarray(self.spring, dtype=float)
        except (TypeError, ValueError):
            given = np.full(1, np.nan)
        if given.shape in ((self.gdim,), (self.modes,)):
            C[np.arange(given.size), np.arange(given.size)] = given
        elif given.shape == C.shape:
            C = given
        else:
            raise InputError(
                f"{self._label}: the spring is {self.spring!r}; {self.gdim} numbers for the "
                f"translation, {self.modes} for translation and rotation, or a {self.modes} x "
                f"{self.modes} matrix are expected"
            )
        largest = np.abs(C).max()
        if not np.isfinite(C).all() or np.abs(C - C.T).max() > RELATIVE_ROUNDING * largest:
            raise InputError(f"{self._label}: the stiffness of the spring is not symmetric")
        size = np.sqrt(np.abs(C.diagonal()))
        size[size == 0.0] = 1.0
        if np.linalg.eigvalsh(C / np.outer(size, size))[0] < -RELATIVE_ROUNDING:
            raise InputError(
                f"{self._label}: the stiffness of the spring is negative in some direction"
            )
        return C

    @property
    def _motion(self) -> Vector:
        """The motion now (modes,), NaN where it is free."""
        parts = (("translation", self.gdim), ("rotation", self.modes - self.gdim))
        return np.concatenate([self._components(name, size, free=True) for name, size in parts])

    def _components(self, name: str, size: int, free: bool = False) -> Vector:
        """Return the components of an attribute now, NaN where it is free."""
        given = getattr(self, name)
        value = getattr(given, "value", given)
        entries = [value] * size if value is None or np.ndim(value) == 0 else list(value)
        fits = len(entries) == size and all(
            is_number(entry) or (free and entry is None) for entry in entries
        )
        if not fits:
            word = "number or None" if free else "finite number"
            many = f"{size} {word.replace('number', 'numbers')} are expected, or one for all"
            expected = many if size > 1 else f"a {word} is expected"
            raise InputError(f"{self._label}: {name} is {value!r}; {expected}")
        return np.array([np.nan if entry is None else entry for entry in entries], dtype=float)
