"""Fields computed from a solution, and files of fields for ParaView."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from xml.etree import ElementTree

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx.fem import Function, FunctionSpace
from dolfinx.io import VTKFile
from dolfinx.mesh import Mesh

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.contact.solution.results import ContactResult
from fenics_tfeti.fem.topology import nodes_in, owned_cells, tags_of_cells
from fenics_tfeti.fem.user_data import is_number
from fenics_tfeti.feti.files.arrays import errors_named, folder_of
from fenics_tfeti.parallel import meet, raise_collectively


def von_mises(mesh: Mesh, stress: Any, poisson_ratio: float | None = None) -> Function:
    """Evaluate the von Mises stress at the midpoint of each cell. Collective.

    Parameters
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh.
    stress : UFL expression, 3 x 3 or 2 x 2
        Stress tensor [Pa], in terms of the displacement. In two dimensions either the 3 x 3 tensor,
        or its 2 x 2 in-plane part together with `poisson_ratio`.
    poisson_ratio : float, optional
        For a 2 x 2 tensor: the out-of-plane normal stress is poisson_ratio (s_xx + s_yy), as in
        plane strain of an isotropic body. Pass 0 for plane stress.

    Returns
    -------
    dolfinx.fem.Function
        Constant on each cell [Pa], named "von_mises_stress".

    Raises
    ------
    InputError
        If `stress` has another shape, or is a 2 x 2 tensor without `poisson_ratio`.

    Notes
    -----
    Where the stress is not constant on a cell, its largest values at the vertices are not shown.

    Examples
    --------
    >>> stress = von_mises(mesh, sigma(uh))  # doctest: +SKIP
    >>> stress = von_mises(mesh, sigma(uh), poisson_ratio=0.3)  # plane strain  # doctest: +SKIP
    """
    meet(mesh.comm, "von_mises()")
    with raise_collectively(mesh.comm):
        stress = ufl.as_ufl(stress)
        _check_stress(stress, poisson_ratio)
    if stress.ufl_shape == (2, 2):
        ratio = poisson_ratio or 0.0
        stress = with_third_direction(stress, ratio * ufl.tr(stress))
    deviator = stress - ufl.tr(stress) / 3 * ufl.Identity(3)
    constants = _compat.lagrange_space(mesh, 0, discontinuous=True)
    result = Function(constants, name="von_mises_stress")
    equivalent = ufl.sqrt(3 / 2 * ufl.inner(deviator, deviator))
    result.interpolate(_compat.compiled_expression(equivalent, result.function_space))
    return result


def with_third_direction(plane: Any, value: Any) -> Any:
    """Return a tensor, 3 x 3, with a part in a plane, 2 x 2, and a value normal to it."""
    (a, b), (c, d) = ((plane[i, 0], plane[i, 1]) for i in (0, 1))
    return ufl.as_tensor([[a, b, 0], [c, d, 0], [0, 0, value]])


def write_fields(
    path: str | os.PathLike[str],
    functions: Function | Sequence[Function],
    time: float | None = None,
) -> None:
    """Write fields to files for ParaView: `path` and the files that it refers to. Collective.

    Under MPI each rank writes its part. Calls with a growing `time` make a series: a step is added
    to those that the file has, in place of any of the same time or later. A run that starts again
    so replaces the series, and one that goes on from a checkpoint continues it.

    Parameters
    ----------
    path : path-like
        Name of the file, with the suffix .pvd. Its folder is created if it does not exist.
    functions : dolfinx.fem.Function or sequence of dolfinx.fem.Function
        Scalar and vector fields on one mesh, continuous of degree 1 or 2 or constant on each cell.
        Each is written under its ``name``; the names have to differ. With one of degree 2, or cells
        of degree 2, continuous ones are all written as such.
    time : float, optional
        Time, load factor or number of the step. By default the file has these fields alone.

    Raises
    ------
    InputError
        If a field or a name is wrong; then nothing is written.
    OSError
        On all ranks, if the files cannot be written; then files that exist are left as they are.
    """
    path = Path(path)
    functions = [functions] if isinstance(functions, Function) else list(functions)
    if not functions:
        raise InputError("there are no fields to write: pass at least one function")
    mesh = functions[0].function_space.mesh
    comm = mesh.comm
    meet(comm, "write_fields()")
    with raise_collectively(comm):
        _check_fields(path, functions)
        if time is not None and not is_number(time):
            raise InputError(f"time is {time!r}; a finite number is expected")
    degree = max(_compat.geometry_degree(mesh), *(field_degree(function) for function in functions))
    # the writer takes continuous fields of one degree
    functions = [raised_to_degree(function, degree) for function in functions]
    folder: Path | None = None
    with ExitStack() as folders:
        with raise_collectively(comm), errors_named("fields", path):
            if comm.rank == 0:
                folders.enter_context(folder_of(path))
                new = TemporaryDirectory(
                    prefix=f".{path.stem}.", dir=path.parent, ignore_cleanup_errors=True
                )
                folder = Path(folders.enter_context(new))
        folder = comm.bcast(folder)
        with raise_collectively(comm), errors_named("fields", path):
            _write_piece(folder / str(comm.rank), functions)
        with raise_collectively(comm), errors_named("fields", path):
            if comm.rank == 0:
                earlier = [] if time is None else _earlier_steps(path, time)
                _move_files(folder, path, comm.size, earlier, time or 0.0)


def _write_piece(folder: Path, functions: Sequence[Function]) -> None:
    """Write the files of this rank alone: the writer of all ranks waits for one that fails."""
    folder.mkdir()
    file = VTKFile(MPI.COMM_SELF, str(folder / "piece.pvd"), "w")
    try:
        file.write_function(functions, 0.0)
        file.close()
    except RuntimeError:
        pass  # what it has written tells
    # it writes the collection once more when it is deleted, which must not be later
    del file
    written = sorted(folder.glob("*.*"))
    if not any(name.suffix == ".vtu" for name in written) or not all(map(_is_whole, written)):
        raise OSError(errno.ENOSPC, "a file is incomplete: is the disk full?")


def _is_whole(file: Path) -> bool:
    with file.open("rb") as content:
        content.seek(max(0, file.stat().st_size - 64))
        return content.read().rstrip().endswith(b"</VTKFile>")


def raised_to_degree(function: Function, degree: int) -> Function:
    """Return a field in the space of a higher degree; one that is constant on cells as it is."""
    if field_degree(function) in (0, degree):
        return function
    (components,) = _compat.element_facts(function.function_space)[2] or (0,)
    space = _compat.lagrange_space(function.function_space.mesh, degree, components)
    raised = Function(space, name=function.name)
    raised.interpolate(function)
    return raised


def _earlier_steps(path: Path, time: float) -> list[tuple[float, str]]:
    """Return times and files of the steps before a time in a collection, if there is one."""
    if not path.exists():
        return []
    try:
        entries = [entry.attrib for entry in ElementTree.parse(path).iter("DataSet")]
        steps = [(float(entry["timestep"]), entry["file"]) for entry in entries]
    except (ElementTree.ParseError, KeyError, ValueError):
        raise InputError(f"{path} is not a collection of ParaView: choose another name") from None
    return [step for step in steps if step[0] < time]


def _move_files(
    folder: Path, path: Path, ranks: int, earlier: list[tuple[float, str]], time: float
) -> None:
    """Move the files of all ranks to where they belong, the collection last."""
    index, step = next((folder / "0").glob("*.pvtu")), f"{len(earlier):06d}"
    pieces = [f"{path.stem}_p{rank}_{step}.vtu" for rank in range(ranks)]
    _compat.list_pieces(index, pieces)
    collection = folder / "collection.pvd"
    steps = [*earlier, (time, f"{path.stem}{step}.pvtu")]
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    listed = ElementTree.SubElement(root, "Collection")
    for at, name in steps:
        ElementTree.SubElement(listed, "DataSet", timestep=repr(float(at)), part="0", file=name)
    ElementTree.ElementTree(root).write(collection, encoding="utf-8", xml_declaration=True)
    targets = {next((folder / str(rank)).glob("*.vtu")): pieces[rank] for rank in range(ranks)}
    targets |= {index: steps[-1][1], collection: path.name}
    for name in targets.values():
        if path.with_name(name).is_dir():
            raise OSError(errno.EISDIR, f"{name} is a folder")
    for file, name in targets.items():
        file.chmod(0o644)
        file.replace(path.with_name(name))


def field_degree(function: Function) -> int:
    """Return 1 or 2 for a continuous field, 0 for one that is constant on each cell; or raise."""
    family, degree, _ = _compat.element_facts(function.function_space)
    if (family, degree) in (("Lagrange", 1), ("Lagrange", 2), ("Discontinuous Lagrange", 0)):
        return degree
    raise InputError(
        f"'{function.name}' ({family}, degree {degree}) is neither continuous of degree 1 or 2 nor "
        "constant on each cell; interpolate it into such a space first"
    )


def _check_stress(stress: Any, poisson_ratio: float | None) -> None:
    if stress.ufl_shape not in {(2, 2), (3, 3)}:
        raise InputError(
            f"the stress has shape {stress.ufl_shape}; a tensor of shape (3, 3) or (2, 2) is "
            "expected"
        )
    if stress.ufl_shape == (2, 2) and poisson_ratio is None:
        raise InputError(
            "the out-of-plane stress is missing: pass poisson_ratio for plane strain, 0 for plane "
            "stress, or a stress tensor of shape (3, 3)"
        )


def _check_fields(path: Path, functions: Sequence[Function]) -> None:
    """Check the names and spaces of fields before the writer starts a file."""
    if path.suffix != ".pvd":
        raise InputError(f"'{path}' does not end in .pvd, the suffix of ParaView's collections")
    count = Counter(function.name for function in functions)
    for name, times in count.items():
        if not name.strip():
            raise InputError("a field has no name: set it, as in uh.name = 'displacement'")
        if times > 1:
            raise InputError(f"{times} fields have the name '{name}': give each its own")
    mesh = functions[0].function_space.mesh
    for function in functions:
        if function.function_space.mesh is not mesh:
            raise InputError(f"'{function.name}' is on another mesh than '{functions[0].name}'")
        field_degree(function)


def displacement_space(mesh: Mesh, degree: int = 1) -> FunctionSpace:
    """Return the space of displacements: Lagrange elements with gdim components.

    It saves scripts from the differences between the versions of dolfinx.

    Parameters
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh.
    degree : int
        1 or 2; on curved cells 2.

    Examples
    --------
    >>> V = displacement_space(mesh)  # doctest: +SKIP
    >>> V = displacement_space(curved_mesh, degree=2)  # doctest: +SKIP
    """
    return _compat.lagrange_space(mesh, degree, mesh.geometry.dim)


def piecewise_constant(mesh: Mesh, cell_tags: Any, values: Mapping[int, float]) -> Function:
    """Return a function that is constant on each cell, such as Young's modulus. Collective.

    Parameters
    ----------
    mesh : dolfinx.mesh.Mesh
        The mesh.
    cell_tags : dolfinx.mesh.MeshTags
        A tag for every cell.
    values : dict of int to float
        The value on the cells with each tag.

    Raises
    ------
    InputError
        If a cell has no tag, or a tag no value.

    Examples
    --------
    >>> E = piecewise_constant(mesh, cell_tags, {1: 2.1e11, 2: 7e10})  # doctest: +SKIP
    >>> sigma = isotropic(E, 0.3)  # doctest: +SKIP
    """
    space = _compat.lagrange_space(mesh, 0, discontinuous=True)
    result = Function(space)
    tags = tags_of_cells(mesh, cell_tags)
    with raise_collectively(mesh.comm):
        missing = np.setdiff1d(tags, list(values))
        if missing.size:
            raise InputError(
                f"cells with the tags {missing.tolist()} have no value; values are given for the "
                f"tags {sorted(values)}"
            )
        dofs = _compat.cell_dofs(space)[: owned_cells(mesh), 0]
        for tag, value in values.items():
            result.x.array[dofs[tags == tag]] = value
    result.x.scatter_forward()
    return result


class ContactFields(NamedTuple):
    """Contact results as fields, in this order.

    They are of degree 1: for displacements of degree 2 as well, contact is at the vertices. The
    integral of the pressure over a slave surface, deformed where contact is on deformed surfaces,
    is the contact's force in the report, where it is covered wholly; where the slave sticks out of
    the master, the sum of ``pressure * area`` of the `ContactResult` is.

    Attributes
    ----------
    pressure : Function
        "contact_pressure" of `ContactResult` [Pa]; zero off the surfaces, as all forces are.
    force : Function
        "contact_force" [N]: normal, times the outward normal; a vector.
    gap, opening : Function
        "initial_gap" and "opening", the gaps before and after the solve [m]: NaN off the surfaces
        and where a contact has no obstacle. In forms, fill them by ``numpy.nan_to_num``.

    Examples
    --------
    >>> fields = contact_fields(V, problem.results)  # doctest: +SKIP
    >>> write_fields("result.pvd", [uh, *fields])  # doctest: +SKIP
    """

    pressure: Function
    force: Function
    gap: Function
    opening: Function


class FrictionFields(NamedTuple):
    """Contact results as fields where a contact has friction, in this order.

    Attributes
    ----------
    pressure, force, gap, opening : Function
        As in `ContactFields`.
    traction, slip : Function
        "friction_traction" [Pa], on the slave, and "slip" [m]; vectors.
    state : Function
        "friction_state": 1 where a node sticks, 2 where it slips, 0 where friction has no force.
    """

    pressure: Function
    force: Function
    gap: Function
    opening: Function
    traction: Function
    slip: Function
    state: Function


class BondFields(NamedTuple):
    """Contact results as fields where a contact has bonds that break, in this order.

    Attributes
    ----------
    pressure, force, gap, opening, traction, slip, state : Function
        As in `FrictionFields`; the pressure is negative where bonds pull.
    damage : Function
        "damage": 1 where nothing is bonded or bonds have failed, zero off the surfaces.
    """

    pressure: Function
    force: Function
    gap: Function
    opening: Function
    traction: Function
    slip: Function
    state: Function
    damage: Function


def contact_fields(
    space: FunctionSpace, results: Iterable[Any]
) -> ContactFields | FrictionFields | BondFields:
    """Return the contact results as fields. Collective.

    Parameters
    ----------
    space : FunctionSpace
        The displacement's space.
    results : sequence of ContactResult
        ``results`` of a `ContactProblem`; those of tied pairs are left out. Where a node is in
        several contacts, their values are added; of gaps and openings it is the smallest.

    Returns
    -------
    ContactFields, FrictionFields or BondFields
        Named tuples of functions; with those of friction where a contact has friction, and with
        these and damage where one has bonds that break.

    Raises
    ------
    InputError
        On all ranks, if results are gathered on a rank without all of their nodes.

    Examples
    --------
    >>> pressure, force, gap, opening = contact_fields(V, problem.results)  # doctest: +SKIP
    >>> opening = contact_fields(V, problem.results).opening  # doctest: +SKIP
    """
    meet(space.mesh.comm, "contact_fields()")
    contacts = [result for result in results if isinstance(result, ContactResult)]
    with raise_collectively(space.mesh.comm):
        if any(contact.dofs.min(initial=0) < 0 for contact in contacts):
            raise InputError(
                "contact_fields: the results are gathered, with nodes of other ranks. Pass "
                "problem.results, which has those of this rank"
            )
    scalar = _compat.lagrange_space(space.mesh, 1)
    # some versions of dolfinx compile no form of a field whose name has spaces
    names = ("contact_pressure", "initial_gap", "opening", "friction_state", "damage")
    pressure, gap, opening, state, damage = (Function(scalar, name=name) for name in names)
    block = space.dofmap.index_map_bs
    linear = _compat.element_facts(space)[1] == 1
    vector = space if linear else _compat.lagrange_space(space.mesh, 1, block)
    force = Function(vector, name="contact_force")
    to_scalar, to_vector = (nodes_in(other, space) for other in (scalar, vector))
    gap.x.array[:] = opening.x.array[:] = np.inf
    traction, slip = (Function(vector, name=name) for name in ("friction_traction", "slip"))
    for contact in contacts:
        # forces are drawn on the body that has the nodes
        contact = contact.seen_from_master() if contact.on_master else contact
        nodes = contact.dofs
        scalar_dofs = to_scalar[nodes]
        pressure.x.array[scalar_dofs] += contact.pressure
        gap.x.array[scalar_dofs] = np.minimum(gap.x.array[scalar_dofs], contact.gap)
        opening.x.array[scalar_dofs] = np.minimum(opening.x.array[scalar_dofs], contact.opening)
        components = block * to_vector[nodes][:, None] + np.arange(block)
        force.x.array[components] -= contact.nodal_normal_force[:, None] * contact.normal
        if contact.damage is not None:
            damage.x.array[scalar_dofs] = np.maximum(damage.x.array[scalar_dofs], contact.damage)
        if contact.friction is not None:
            traction.x.array[components] += contact.friction.traction
            slip.x.array[components] += contact.friction.slip
            state.x.array[scalar_dofs] = np.maximum(
                state.x.array[scalar_dofs], contact.friction.state
            )
    for field in (gap, opening):
        field.x.array[np.isinf(field.x.array)] = np.nan
    for field in (pressure, force, gap, opening, traction, slip, state, damage):
        field.x.scatter_forward()
    of_friction = (traction, slip, state)
    if any(contact.damage is not None for contact in contacts):
        return BondFields(pressure, force, gap, opening, *of_friction, damage)
    if any(contact.friction is not None for contact in contacts):
        return FrictionFields(pressure, force, gap, opening, *of_friction)
    return ContactFields(pressure, force, gap, opening)
