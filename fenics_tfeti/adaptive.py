"""Meshes that follow the error: solve, estimate, mark and refine until it is small enough."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from fenics_tfeti.errors import InputError, NotConverged, check_value, wrong_type
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.io.refinement import refine
from fenics_tfeti.fem.io.tagged_mesh import TaggedMesh
from fenics_tfeti.fem.mesh_error.estimate import MeshError
from fenics_tfeti.fem.user_data import check_positive, is_integer
from fenics_tfeti.parallel import print_on_first_rank, raise_collectively
from fenics_tfeti.problem import ContactProblem

logger = logging.getLogger(__name__)

# share of the error in the cells that are refined
_SHARE = 0.4
# what sizes of a new mesh are for, relative to the error: it has the sizes in the mean only
_AIM = 0.9
# an error that is smaller by no more than this, with a new mesh, will not be small enough
_STAGNATION = 0.98


@dataclass(frozen=True)
class MeshLevel:
    """One mesh of `adapt`.

    Attributes
    ----------
    unknowns : int
        Of the displacement.
    error : float
        The estimated error of the mesh, see `MeshError`.
    products : int
        Products with F of the solve.
    """

    unknowns: int
    error: float
    products: int

    def __str__(self) -> str:
        """Return the level as a line to read."""
        return (
            f"{self.unknowns:9d} unknowns: error of the mesh about {100.0 * self.error:.3g} %, "
            f"{self.products} products"
        )


class Adapted(NamedTuple):
    """The solution on the last mesh of `adapt`.

    Attributes
    ----------
    problem : ContactProblem
        The last problem, solved.
    estimate : MeshError
        Its error of the mesh.
    levels : list of MeshLevel
        All meshes, the last one last.
    """

    problem: ContactProblem
    estimate: MeshError
    levels: list[MeshLevel]


def adapt(
    make_problem: Callable[[TaggedMesh], ContactProblem],
    mesh: TaggedMesh,
    *,
    error: float,
    max_unknowns: int = 100_000,
    remesh: Callable[[Any], TaggedMesh] | None = None,
    print_progress: bool = False,
) -> Adapted:
    """Solve on meshes that follow the error, until it is small enough. Collective.

    Each solve starts from the contact of the mesh before.

    Parameters
    ----------
    make_problem : callable
        Returns the problem, not solved, on a mesh with tags.
    mesh : TaggedMesh
        The first mesh.
    error : float
        The error of the mesh at which to end, in the energy norm, relative to the displacement's.
    max_unknowns : int
        A mesh with more of them is the last one.
    remesh : callable, optional
        Returns a new mesh with cell sizes (a Function of degree 1), see
        `fenics_tfeti.io.set_mesh_sizes`. By default the cells with two fifths of the error are
        refined, which is for triangles and tetrahedra with straight edges whose surfaces in contact
        with each other are plane.
    print_progress : bool
        Whether to print a line for each mesh.

    Returns
    -------
    Adapted
        The last problem, solved, its estimate, and all meshes.

    Raises
    ------
    InputError
        If an argument is wrong, cells cannot be refined, or the gaps of a pair of curved surfaces
        would be those of refined facets.
    NotConverged
        If a new mesh of `remesh` hardly has a smaller error.

    Examples
    --------
    >>> problem, estimate, levels = adapt(make_problem, mesh, error=0.05)  # doctest: +SKIP
    """
    with raise_collectively(mesh.mesh.comm):
        check_positive(error, "adapt: error")
        is_count = is_integer(max_unknowns) and max_unknowns > 0
        check_value(is_count, "adapt: max_unknowns", max_unknowns, "a positive integer")
    levels, coarse, aim = list[MeshLevel](), None, _AIM * error
    while True:
        problem = make_problem(mesh)
        if not isinstance(problem, ContactProblem):
            raise wrong_type("adapt: make_problem's result", problem, "a ContactProblem")
        problem.solve(coarse=coarse)
        estimate = problem.mesh_error()
        level = MeshLevel(
            problem.report.unknowns["primal"],
            estimate.error,
            problem.report.products["total"],
        )
        levels.append(level)
        logger.info("%s", level)
        if print_progress:
            print_on_first_rank(mesh.mesh.comm, str(level))
        if level.error <= error or level.unknowns > max_unknowns:
            return Adapted(problem, estimate, levels)
        if remesh is None:
            _check_surfaces(problem)
            mesh = refine(mesh, estimate.mark(_share(estimate, error)))
        else:
            _check_progress(levels, problem)
            if len(levels) > 1:
                # at edges and where contact ends the error falls more slowly than sizes expect
                aim *= error / level.error
            mesh = remesh(estimate.sizes(aim))
        coarse = problem if problem.options.solver.method == "active_set" else None


def _share(estimate: MeshError, error: float) -> float:
    """Return the share of the error in cells to refine, or less where less will do.

    Cells of half the size have errors that are smaller by their degree's power of two.
    """
    degree = _compat.element_facts(estimate.space)[1]
    wanted = 1.0 - (error / estimate.error) ** 2
    return min(_SHARE, wanted / (1.0 - 0.25**degree))


def _check_surfaces(problem: ContactProblem) -> None:
    """Check that no pair has facets that approximate a curved surface."""
    for entry in problem.report.contacts:
        matching = entry.matching
        deviation = matching.get("deviation")
        if deviation and matching["discretisation"] == "mortar" and entry.matching["blurred"]:
            raise InputError(
                f"adapt: {entry.name!r} is between curved surfaces, whose facets deviate by up to "
                f"{deviation:.3g} from them. Refined facets do not match, and pressures would "
                "oscillate: give adapt() a function remesh, which makes a new mesh"
            )


def _check_progress(levels: list[MeshLevel], problem: ContactProblem) -> None:
    """Check that a new mesh has a smaller error."""
    if len(levels) > 1 and levels[-1].error > _STAGNATION * levels[-2].error:
        raise NotConverged(
            f"adapt: the new mesh has an error of about {100 * levels[-1].error:.3g} %, the one "
            f"before {100 * levels[-2].error:.3g} %: does remesh use the sizes, or is a limit "
            "of Gmsh in their way?",
            problem.u,
            problem.report,
        )
