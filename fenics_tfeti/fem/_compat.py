"""Adapter to dolfinx 0.5.2 and 0.9 to 0.11: the only file that depends on the version.

One function for each difference. Its docstring says what each version does; the function dispatches
by an attribute or an argument, before any communication, or serves all versions.
"""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from mpi4py import MPI

import numpy as np

import dolfinx
import ufl
from dolfinx import cpp, fem, la, mesh
from ufl.algorithms import extract_coefficients
from ufl.algorithms.analysis import extract_type
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.algorithms.check_arities import ArityMismatch, check_form_arity
from ufl.algorithms.remove_complex_nodes import remove_complex_nodes
from ufl.differentiation import CoefficientDerivative, VariableDerivative

from fenics_tfeti.fem.assembly_loops import integrate
from fenics_tfeti.fem.form_numbers import with_constants
from fenics_tfeti.fem.geometry.reference_cells import reference_cell
from fenics_tfeti.typing import Array, Indices, Numbers, Vector


def version() -> str:
    """Return dolfinx's version."""
    return str(dolfinx.__version__)


@contextmanager
def compiling(functions: Iterable[Any] = ()) -> Iterator[None]:
    """Suppress logged command lines, and give functions names that are identifiers.

    - 0.5.2 asks setuptools to log command lines as INFO of the root logger, and has given that
      logger a handler when ``ffcx`` was imported; it makes names in C of a function's name, which
      may have spaces;
    - 0.9 to 0.11 write nothing, and do not use the names.

    Warnings and errors of setuptools are logged, and what the compiler writes is not touched.
    """
    root, names = logging.getLogger(), [(w, w.name) for w in functions if not w.name.isidentifier()]
    root.addFilter(_is_no_command_line)
    for number, (w, _) in enumerate(names):
        w.name = f"renamed_{number}"
    try:
        yield
    finally:
        root.removeFilter(_is_no_command_line)
        for w, name in names:
            w.name = name


def _is_no_command_line(record: logging.LogRecord) -> bool:
    return record.levelno > logging.INFO or "distutils" not in record.pathname


# -- meshes and function spaces ----------------------------------------------------------------


def cpp_object(thing: Any) -> Any:
    """Return the C++ object inside a Python one.

    - 0.5.2 keeps that of a mesh in ``_mesh``; mesh tags inherit from theirs;
    - 0.9 to 0.11 keep all of them in ``_cpp_object``.
    """
    for name in ("_cpp_object", "_mesh"):
        if hasattr(thing, name):
            return getattr(thing, name)
    return thing


def lagrange_space(
    domain: mesh.Mesh, degree: int, components: int = 0, discontinuous: bool = False
) -> fem.FunctionSpace:
    """Create a space of Lagrange functions with some components (0: scalar).

    - 0.5.2 has ``FunctionSpace`` and ``VectorFunctionSpace`` for (family, degree), and logs a
      warning for discontinuous functions that have not the name of their cells;
    - 0.9 to 0.11 have ``functionspace`` for (family, degree, shape).
    """
    family = "DG" if discontinuous else "Lagrange"
    _name_node_spacing(domain)
    with compiling():
        if hasattr(fem, "functionspace"):
            shape = ((components,),) if components else ()
            return fem.functionspace(domain, (family, degree, *shape))
        if discontinuous and not reference_cell(cell_name(domain)).is_simplex:
            family = "DQ"
        if components:
            return fem.VectorFunctionSpace(domain, (family, degree), dim=components)
        return fem.FunctionSpace(domain, (family, degree))


def symbolic_space(domain: mesh.Mesh, degree: int, components: int) -> ufl.FunctionSpace:
    """Return a space of discontinuous Lagrange functions, for forms that are compiled alone.

    - 0.5.2 has elements of UFL, 0.9 to 0.11 those of ``basix.ufl``.
    """
    name = cell_name(domain)
    if hasattr(ufl, "VectorElement"):
        family = "DG" if reference_cell(name).is_simplex else "DQ"
        element = ufl.VectorElement(family, domain.ufl_cell(), degree, dim=components)
    else:
        import basix.ufl

        element = basix.ufl.element("DG", name, degree, shape=(components,))
    return ufl.FunctionSpace(domain.ufl_domain(), element)


def element_facts(space: fem.FunctionSpace) -> tuple[str, int, tuple[int, ...]]:
    """Return family ("Lagrange", "Discontinuous Lagrange", ...), degree and value shape.

    - 0.5.2 has UFL elements with ``family()``, ``degree()``, ``value_shape()``; vector elements
      hide their scalar one in ``sub_elements()``;
    - 0.9 to 0.11 have elements of ``basix.ufl`` with ``family_name``, ``degree``,
      ``discontinuous`` and ``reference_value_shape``.
    """
    element = space.ufl_element()
    if callable(element.degree):
        shape = tuple(element.value_shape())
        scalar = element.sub_elements()[0] if element.num_sub_elements() else element
        family = {"Q": "Lagrange", "DQ": "Discontinuous Lagrange"}.get(
            scalar.family(), scalar.family()
        )
        return family, int(scalar.degree()), shape
    scalar = element.sub_elements[0] if getattr(element, "block_size", 1) > 1 else element
    family = {"P": "Lagrange", "Q": "Lagrange"}.get(scalar.family_name, scalar.family_name)
    if family == "Lagrange" and scalar.discontinuous:
        family = "Discontinuous Lagrange"
    return family, int(scalar.degree), tuple(element.reference_value_shape)


def cell_dofs(space: fem.FunctionSpace) -> Indices:
    """Return the (blocked) degrees of freedom of each cell of this rank, ghosts included.

    - 0.5.2 has an adjacency list, 0.9 to 0.11 a matrix.
    """
    dofs = space.dofmap.list
    # a rank may have no cells
    return np.asarray(getattr(dofs, "array", dofs)).reshape(-1, space.dofmap.dof_layout.num_dofs)


def input_cells(domain: mesh.Mesh) -> Numbers:
    """Return the place of each owned cell in the input of the mesh; of a submesh global numbers.

    - 0.5.2 and 0.9 have an empty array for submeshes, 0.10 and 0.11 raise a RuntimeError.
    """
    cells = domain.topology.index_map(domain.topology.dim)
    try:
        numbers = np.asarray(domain.topology.original_cell_index, dtype=np.int64)
    except RuntimeError:
        numbers = np.zeros(0, dtype=np.int64)
    return numbers[: cells.size_local] if numbers.size else np.arange(*cells.local_range)


def geometry_cells(domain: mesh.Mesh) -> Indices:
    """Return the rows of ``geometry.x`` of each cell of this rank, ghosts included.

    - 0.5.2 has ``geometry.dofmap``, an adjacency list;
    - 0.9 and 0.10 have a matrix, 0.11 one for each cell type in ``geometry.dofmaps``, the other
      deprecated.
    """
    geometry = domain.geometry
    if hasattr(geometry, "dofmaps") and not callable(geometry.dofmaps):
        return np.asarray(geometry.dofmaps[0])
    nodes = geometry.dofmap
    if hasattr(nodes, "array"):
        return np.asarray(nodes.array).reshape(-1, geometry.cmap.create_dof_layout().num_dofs)
    return np.asarray(nodes)


def geometry_degree(domain: mesh.Mesh) -> int:
    """Return the degree of the cells' geometry: 1, 2, or 3 for any other.

    - 0.5.2, 0.9 and 0.10 have ``geometry.cmap``, 0.11 ``geometry.cmaps``. The number of nodes says
      the same in all of them.
    """
    nodes, cell = geometry_cells(domain).shape[1], reference_cell(cell_name(domain))
    return next((degree for degree in (1, 2) if nodes == cell.nodes(degree)), 3)


def cell_name(domain: mesh.Mesh) -> str:
    """Return the shape of the cells, such as "hexahedron".

    - ``ufl_cell().cellname`` is a method in 0.5.2, 0.9 and 0.10, a property in 0.11.
    """
    name = domain.ufl_cell().cellname
    return str(name() if callable(name) else name)


def bc_values(bc: Any, size: int) -> tuple[Indices, Vector]:
    """Return the unrolled local degrees of freedom of a Dirichlet condition and their values.

    - 0.5.2 has ``fem.set_bc(array, [bc])``, 0.9 to 0.11 ``bc.set(array)``; both take
      values that are functions, constants or arrays. `size` counts this rank's, ghosts included.
    """
    values = np.zeros(size)
    if hasattr(bc, "set"):
        bc.set(values, None, 1.0)
    else:
        fem.set_bc(values, [bc])
    dofs = cpp_object(bc).dof_indices()[0]
    return dofs, values[dofs]


def bc_is_on(bc: Any, space: fem.FunctionSpace) -> bool:
    """Tell whether a Dirichlet condition is on a space or a component of it.

    - ``bc.function_space`` is the C++ space in 0.5.2 and the Python one later.
    """
    return bool(cpp_object(space).contains(cpp_object(bc.function_space)))


def tags_are_on(tags: Any, domain: mesh.Mesh) -> bool:
    """Tell whether mesh tags belong to a mesh.

    - 0.5.2 keeps the mesh in ``tags.mesh``, 0.9 to 0.11 the topology in ``tags.topology``.
    """
    if hasattr(tags, "mesh"):
        return cpp_object(tags.mesh) is cpp_object(domain)
    return cpp_object(tags.topology) is cpp_object(domain.topology)


# -- graphs ------------------------------------------------------------------------------------


def partition_graph(offsets: Indices, neighbours: Indices, count: int) -> Indices:
    """Partition a graph of this rank, in CSR form, by SCOTCH, always into the same parts.

    - All versions have the C++ class and partitioner, and each its own way to them in Python.
    """
    graph = cpp.graph.AdjacencyList_int64(neighbours.astype(np.int64), offsets.astype(np.int32))
    partitioner = cpp.graph.partitioner_scotch(seed=0)
    with _one_scotch_thread():
        return np.array(partitioner(MPI.COMM_SELF, count, graph, False).array)


@contextmanager
def _one_scotch_thread() -> Iterator[None]:
    """Run SCOTCH 7 on one thread: with several, the parts differ from run to run."""
    name = "SCOTCH_PTHREAD_NUMBER"
    value = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if value is None:
            del os.environ[name]
        else:
            os.environ[name] = value


# -- forms -------------------------------------------------------------------------------------


def _name_node_spacing(domain: mesh.Mesh) -> None:
    """Name the spacing of the nodes in a mesh's element, which is part of what a form is cached by.

    - 0.5.2's FFCx names it when it compiles the first form of a mesh, but not when it finds that in
      the cache: without the name, the other forms would be compiled again in the next run;
    - 0.9 to 0.11 have it in the element from the start.
    """
    if hasattr(ufl, "VectorElement"):
        element = domain.ufl_domain().ufl_coordinate_element()
        shape = element.family(), element.cell(), element.degree(), element.quadrature_scheme()
        named = ufl.VectorElement(ufl.FiniteElement(*shape, variant="equispaced"))
        domain.ufl_domain()._ufl_coordinate_element = named


def is_linear_in_arguments(form: ufl.Form) -> bool:
    """Tell whether each term of a form is linear in each of the form's arguments.

    - 0.5.2's UFL fails with a TypeError, that of 0.9 with a ValueError, where it writes the message
      of some ``ArityMismatch``.
    """
    # as UFL does before its own check
    lowered = remove_complex_nodes(apply_algebra_lowering(form))
    if extract_type(lowered, CoefficientDerivative) or extract_type(lowered, VariableDerivative):
        # in 0.11 UFL keeps the form, and with it the mesh and its communicators, for ever
        lowered = apply_derivatives(lowered)
    try:
        check_form_arity(lowered, form.arguments())
    except (ArityMismatch, TypeError, ValueError):
        return False
    return True


@dataclass(frozen=True)
class CompilerOptions:
    """Options of FFCx and of the just-in-time compiler, as dolfinx takes them."""

    form_compiler_options: Mapping[str, Any] | None = None
    jit_options: Mapping[str, Any] | None = None


class CompiledForm:
    """A form compiled once, whose kernels are called cell by cell.

    - 0.5.2 compiles with ``jit.ffcx_jit``, 0.9 to 0.11 with ``fem.compile_form``.

    Rank 0 compiles, then the others load. Forms that differ in numbers only are compiled once.
    """

    def __init__(
        self, form: ufl.Form, domain: mesh.Mesh, compiler: CompilerOptions | None = None
    ) -> None:
        _name_node_spacing(domain)
        self._form = form = with_constants(form, domain)
        self._new = hasattr(fem, "compile_form")
        compile_form = fem.compile_form if self._new else dolfinx.jit.ffcx_jit
        compiler = compiler or CompilerOptions()
        form_options = dict(compiler.form_compiler_options or {})
        if self._new:
            form_options = {"scalar_type": dolfinx.default_scalar_type, **form_options}
        jit_options = dict(compiler.jit_options or {})
        with compiling(form.coefficients()):
            compiled = compile_form(domain.comm, form, form_options, jit_options)
        self._ufcx, self._module = (
            (compiled.ufcx_form, compiled.module) if self._new else compiled[:2]
        )

    @property
    def integrals(self) -> list[tuple[str, int, Any]]:
        """Kind ("cell" or "exterior_facet"), tag and compiled kernel of each integral.

        The tag of integrals over "everywhere" is -1; those over tags come in addition.

        - 0.5.2 has functions ``integrals``, ``integral_ids`` and ``num_integrals`` of the kind;
        - 0.9 to 0.11 have arrays of all kinds, with offsets.
        """
        form, integrals = self._ufcx, []
        for number, kind in enumerate(("cell", "exterior_facet")):
            if self._new:
                begin, end = (form.form_integral_offsets[i] for i in (number, number + 1))
                ids, of_kind = form.form_integral_ids, form.form_integrals
            else:
                begin, end = 0, form.num_integrals(number)
                ids, of_kind = form.integral_ids(number), form.integrals(number)
            for i in range(begin, end):
                integrals.append((kind, int(ids[i]), of_kind[i].tabulate_tensor_float64))
        return integrals

    @property
    def coefficients(self) -> list[fem.Function]:
        """The coefficients in the order of the kernels.

        - 0.5.2 has ``original_coefficient_position``, 0.9 to 0.11 the same with an s.
        """
        form, functions = self._ufcx, self._form.coefficients()
        name = "original_coefficient_position" + "s" * self._new
        return [functions[getattr(form, name)[i]] for i in range(form.num_coefficients)]

    def add_element_tensors(
        self,
        kernel: Any,
        tensors: Vector,
        rows: Array,
        coefficients: Vector,
        coordinates: Vector,
        facets: Indices | None = None,
    ) -> None:
        """Add an integral over some cells, or over a facet of each, to their element tensors.

        - Kernels of 0.5.2 and 0.9 have six arguments, those of 0.10 and 0.11 a last one for data of
          the user.

        `rows` are those of the cells in the tensors (m, ...), the
        coefficients (m, w) and the coordinates (m, v, 3) of the nodes of the geometry. Facets are
        local numbers, one for each of the rows.
        """
        ffi = self._module.ffi
        constants = np.concatenate([[], *(np.ravel(c.value) for c in self._form.constants())])
        address, arguments = int(ffi.cast("uintptr_t", kernel)), len(ffi.typeof(kernel).args)
        integrate(address, arguments, rows, tensors, coefficients, constants, coordinates, facets)


def assembled(form: ufl.Form, space: fem.FunctionSpace) -> Vector:
    """Return the values of a linear form on a space at dofs that this rank owns. Collective.

    - ``assemble_vector`` leaves what belongs to ghosts to be added to their owners'; 0.5.2 names
      that ``la.ScatterMode``, 0.9 to 0.11 ``la.InsertMode``.
    """
    compiled = with_constants(form, space.mesh)
    with compiling(compiled.coefficients()):
        vector = fem.assemble_vector(fem.form(compiled))
    vector.scatter_reverse(_add())
    return owned(vector.array, space)


def summed_at_owners(values: Vector, space: fem.FunctionSpace) -> Vector:
    """Return values at all dofs of this rank summed up at their owners. Collective."""
    function = fem.Function(space)
    function.x.array[:] = values
    function.x.scatter_reverse(_add())
    return owned(function.x.array, space)


def owned(values: Vector, space: fem.FunctionSpace) -> Vector:
    """Return a copy of the values at the dofs that this rank owns."""
    dofs = space.dofmap
    return np.array(values[: dofs.index_map.size_local * dofs.index_map_bs])


def _add() -> Any:
    modes = la.InsertMode if hasattr(la, "InsertMode") else la.ScatterMode
    return modes.add


# -- meshes, files and pictures ----------------------------------------------------------------


def distributed_mesh(
    comm: MPI.Comm,
    cells: Numbers,
    points: Vector,
    cell: str,
    degree: int = 1,
    ranks: Numbers | None = None,
) -> dolfinx.mesh.Mesh:
    """Create a distributed mesh from each rank's share of cells (m, n) and points (k, gdim) [m].

    Cells go to `ranks` (m,), by default to those that a graph partitioner chooses. Nodes of cells
    are in the order of dolfinx; points are numbered through the ranks.

    - 0.5.2 has ``create_mesh(comm, cells, x, domain)`` and elements from ``ufl``;
    - 0.9 has ``create_mesh(comm, cells, x, e)``, 0.10 and 0.11 ``create_mesh(comm, cells, e, x)``,
      all with elements from ``basix.ufl``;
    - 0.5.2 builds the dual graph of the cells for the partitioner on one process, too, where later
      versions call none: a quarter to a third of the time. An array of cells it converts only
      after an exception, whose message prints all arguments;
    - 0.5.2 needs cells at the borders of ranks on both, and takes nodes there as different
      otherwise.
    """
    gdim, cells = points.shape[1], np.asarray(cells, dtype=np.int64)
    if "domain" in inspect.signature(mesh.create_mesh).parameters:
        shape = ufl.Cell(cell, geometric_dimension=gdim)
        domain = ufl.Mesh(ufl.VectorElement("Lagrange", shape, degree))
        if comm.size == 1:
            ranks = np.zeros(len(cells), dtype=np.int32)
        partitioner = _sending_to(ranks, cells, cell)
        with compiling():
            graph = cpp.graph.AdjacencyList_int64(cells)
            return mesh.create_mesh(comm, graph, points, domain=domain, **partitioner)
    import basix.ufl

    element = basix.ufl.element("Lagrange", cell, degree, shape=(gdim,))
    partitioner = _sending_to(ranks)
    return mesh.create_mesh(comm, cells, x=points, e=ufl.Mesh(element), **partitioner)


def _sending_to(
    ranks: Numbers | None, cells: Numbers | None = None, cell: str = ""
) -> dict[str, Callable[..., Any]]:
    """Return the argument of ``create_mesh`` that sends this process' cells to some ranks.

    With `cells` they are sent to the ranks of their neighbours, too, as ghosts. Partitioners of
    0.5.2 take (comm, size, dim, cells, ghost_mode), those of later versions (comm, size,
    cell_types, cells).
    """
    if ranks is None:
        return {}
    number, destination = np.arange(len(ranks)), np.asarray(ranks, dtype=np.int64)
    if cells is not None:
        ghost, rank = _ghosts(destination, cells, cell)
        number, destination = np.append(number, ghost), np.append(destination, rank)
    # the owner is the first of a cell
    order = np.argsort(number, kind="stable")
    ends = np.append(0, np.cumsum(np.bincount(number, minlength=len(ranks)))).astype(np.int32)
    sent = cpp.graph.AdjacencyList_int32(destination[order].astype(np.int32), ends)
    return {"partitioner": lambda *_: sent}


def _ghosts(ranks: Numbers, cells: Numbers, cell: str) -> tuple[Numbers, Numbers]:
    """Return cells with a facet in common with other ranks' cells, and these ranks."""
    nodes = np.zeros((2, int(cells.max(initial=-1)) + 1), dtype=np.int64)
    nodes[0] = ranks.max(initial=0)
    np.minimum.at(nodes[0], cells, ranks[:, np.newaxis])
    np.maximum.at(nodes[1], cells, ranks[:, np.newaxis])
    facets = cells[:, np.array(reference_cell(cell).facets)]
    at, _ = np.nonzero((nodes[0] < nodes[1])[facets].all(axis=2))
    shared = np.sort(facets[(nodes[0] < nodes[1])[facets].all(axis=2)], axis=1)
    order = np.lexsort(shared.T)
    at, shared = at[order], shared[order]
    both = np.flatnonzero((shared[1:] == shared[:-1]).all(axis=1))
    pairs = np.concatenate([at[both], at[both + 1]]), np.concatenate([at[both + 1], at[both]])
    rows = np.column_stack([pairs[0], ranks[pairs[1]]])[ranks[pairs[0]] != ranks[pairs[1]]]
    cell_and_rank = np.unique(rows, axis=0)
    return cell_and_rank[:, 0], cell_and_rank[:, 1]


def gmsh_order(cell: str, nodes: int) -> Array:
    """Return for each node of a cell in the order of dolfinx its place in that of Gmsh."""
    return np.asarray(cpp.io.perm_gmsh(cpp.mesh.to_type(cell), nodes))


def compiled_expression(expression: Any, space: fem.FunctionSpace) -> fem.Expression:
    """Compile a UFL expression, to be interpolated into functions of a space.

    - ``element.interpolation_points`` is a method in 0.5.2, 0.9 and 0.10, an array in 0.11.
    """
    points = space.element.interpolation_points
    points = points() if callable(points) else points
    expression = with_constants(expression, space.mesh)
    with compiling(extract_coefficients(expression)):
        return fem.Expression(expression, points)


def expression_at(expression: Any, points: Vector, domain: mesh.Mesh) -> fem.Expression:
    """Compile a UFL expression, to be evaluated at points (q, d) of the reference cell."""
    expression = with_constants(expression, domain)
    with compiling(extract_coefficients(expression)):
        return fem.Expression(expression, np.ascontiguousarray(points))


def evaluate_expression(compiled: fem.Expression, domain: mesh.Mesh, cells: Indices) -> Vector:
    """Return the values of a compiled expression in some cells of this rank, cell by cell.

    - ``eval`` has the arguments (cells) in 0.5.2, (mesh, cells) in 0.9 to 0.11.
    """
    has_mesh = "mesh" in inspect.signature(fem.Expression.eval).parameters
    arguments = (domain, cells) if has_mesh else (cells,)
    return np.asarray(compiled.eval(*arguments)).reshape(cells.size, -1)


def list_pieces(index: Path, pieces: Sequence[str]) -> None:
    """Replace the list of .vtu files in the .pvtu file that ``io.VTKFile`` writes on all ranks.

    - 0.5.2 lists the files once for each function, so that ParaView draws the mesh several times;
    - 0.9 to 0.11 list them once.
    """
    tree = ElementTree.parse(index)
    grid = tree.getroot()[0]
    for piece in grid.findall("Piece"):
        grid.remove(piece)
    for name in pieces:
        ElementTree.SubElement(grid, "Piece", Source=name)
    tree.write(index, encoding="utf-8", xml_declaration=True)
