"""Checks of a torn system: every field of every part, on all ranks, before anything is computed.

Each error names the thing and the remedy, and is raised on all ranks. How subdomains are glued is
checked in `bodies`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from fenics_tfeti.errors import InputError
from fenics_tfeti.feti.checks.bodies import check_bodies
from fenics_tfeti.feti.local.fixing_nodes import unknowns_of_nodes
from fenics_tfeti.feti.local.rigid_body_modes import kernel, rigid_body_modes
from fenics_tfeti.feti.system import (
    ContactGuess,
    ContactRows,
    Friction,
    Kernel,
    Prescribed,
    Subdomain,
    TornSystem,
    node_graph,
)
from fenics_tfeti.feti.tolerances import GIVEN, NEGLIGIBLE, ZERO, rounding
from fenics_tfeti.parallel import any_rank, raise_collectively
from fenics_tfeti.typing import Vector

# the directory of nodes computes with numbers of up to twice this
_LARGEST_NODE = 2**61
# the report has an entry for each Dirichlet condition
_MOST_CONDITIONS = 10**6
# deviation of products of tangents and normals from the identity
_NOT_ORTHONORMAL = 1e-8
# the parts of a system, their types, and the words for what is expected
_PARTS = {
    "prescribed": (Prescribed, "a Prescribed; Prescribed() for no prescribed displacement"),
    "contacts": (ContactRows, "ContactRows; ContactRows.none(gdim) for no contact"),
    "tied": (ContactRows, "ContactRows; leave it out where nothing is tied"),
    "friction": (Friction, "Friction; leave it out where nothing rubs"),
}

# shape of an array; None stands for any length
Shape = tuple[int | None, ...]


def check_system(system: TornSystem, stiffness: bool = True) -> None:
    """Check types, shapes, numbers, and how the subdomains are glued. Collective.

    Parameters
    ----------
    system : TornSystem
        The system.
    stiffness : bool
        Whether to check the stiffness matrices and the gluing too; false where that was done for
        the same subdomains.

    Raises
    ------
    InputError
        On all ranks, with the name of what is wrong, and the remedy.
    """
    with raise_collectively(system.comm):
        _check_parts(system)
        if stiffness:
            _check_matrices(system)
    _check_numbering(system)
    if not any_rank(system.comm, [s.stiffness.nnz > 0 for s in system.subdomains]):
        raise InputError(
            "subdomains: none has a stiffness, and nothing says how rigid bodies share forces; add "
            "a deformable one"
        )
    if stiffness:
        check_bodies(system)


def check_types(system: TornSystem) -> None:
    """Check that `subdomains` is a list of `Subdomain`; `InputError` on this rank if not."""
    _check_type("subdomains", system.subdomains, Sequence, "a list of Subdomain")
    for number, subdomain in enumerate(system.subdomains):
        _check_type(f"subdomains[{number}]", subdomain, Subdomain, "a Subdomain")


def check_guess(guess: ContactGuess, rows: int) -> None:
    """Check a contact guess for this rank's contact rows; `InputError` on this rank."""
    _check_type("guess", guess, ContactGuess, "a ContactGuess")
    for name in ("normal_force", "gap"):
        _check_array(f"{name} of the contact guess", getattr(guess, name), (rows,))
    _check_finite("normal_force of the contact guess", guess.normal_force)
    _check_gaps("gap of the contact guess", guess.gap)


def _check_parts(system: TornSystem) -> None:
    """Check all that this rank gives but the entries of stiffness matrices."""
    gdim = system.gdim
    if not isinstance(gdim, int) or gdim not in (2, 3):
        raise InputError(f"gdim: got {gdim!r}, expected 2 or 3")
    for names in ("body_names", "contact_names", "condition_names"):
        _check_names(names, getattr(system, names))
    check_types(system)
    for number, subdomain in enumerate(system.subdomains):
        _check_subdomain(_name(system, number), subdomain, gdim)
    for part, (kind, expected) in _PARTS.items():
        _check_type(part, getattr(system, part), kind, expected)
    _check_prescribed(system.prescribed, gdim)
    _check_rows("contacts", system.contacts, gdim, system.contact_names)
    _check_gaps("contacts.gap", system.contacts.gap)
    _check_rows("tied", system.tied, gdim, system.contact_names)
    _check_finite("tied.gap", system.tied.gap, "Leave rows out where there is nothing to tie to")
    _check_friction(system.friction, system.contacts, gdim)


def _check_matrices(system: TornSystem) -> None:
    """Check this rank's stiffness matrices, each object once."""
    checked: set[int] = set()
    for number, subdomain in enumerate(system.subdomains):
        if subdomain.is_rigid:
            _check_given_motions(f"kernel of {_name(system, number)}", subdomain)
        elif not isinstance(subdomain.kernel, str):
            raise InputError(
                f"kernel of {_name(system, number)}: an array of motions is for a rigid body, and "
                "this one has stiffness. Leave 'kernel' out"
            )
        elif id(subdomain.stiffness) not in checked:
            _check_matrix(f"stiffness of {_name(system, number)}", subdomain, system.gdim)
            checked.add(id(subdomain.stiffness))


def _check_numbering(system: TornSystem) -> None:
    """Check the numbers that have to fit over all ranks. Collective."""
    rank_bodies = np.unique(system.bodies)
    contact = np.append(system.contacts.contact, system.tied.contact)
    gdims, lists, largest, rows = zip(
        *system.comm.allgather(
            (system.gdim, rank_bodies, int(contact.max(initial=-1)), contact.size)
        ),
        strict=True,
    )
    if len(set(gdims)) > 1:
        raise InputError(
            f"gdim differs between the ranks: {', '.join(map(str, gdims))}. Give all ranks the same"
        )
    bodies = np.unique(np.concatenate(lists))
    if bodies.size == 0:
        raise InputError(
            "no subdomains: the torn system has none on any rank. Give at least one rank some"
        )
    if bodies[-1] != bodies.size - 1:
        missing = int(np.flatnonzero(bodies != np.arange(bodies.size))[0])
        raise InputError(
            f"body numbers: {bodies.size} bodies with numbers of up to {bodies[-1]}, but no "
            f"subdomain of body {missing}. Number the bodies 0, 1, ... without gaps"
        )
    if max(largest) >= max(sum(rows), len(system.contact_names)):
        raise InputError(
            f"contacts.contact and tied.contact: contact number {max(largest)} with {sum(rows)} "
            f"contact rows and tied rows, and {len(system.contact_names)} contact_names. Number "
            "the contacts 0, 1, ..."
        )


def _check_type(what: str, value: Any, kind: type[Any], expected: str) -> None:
    if not isinstance(value, kind):
        raise InputError(f"{what}: got {_kind(value)}, expected {expected}")


def _check_names(what: str, names: Any) -> None:
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise InputError(f"{what}: got {_kind(names)}, expected a list of strings")
    for name in names:
        if not isinstance(name, str):
            raise InputError(f"{what}: got {_kind(name)} in it, expected strings")


def _check_fields(label: str, part: Any, dtype: type[np.generic], **shapes: Shape) -> None:
    """Check the arrays of a part; in the label stands FIELD for the name of each."""
    for field, shape in shapes.items():
        _check_array(label.replace("FIELD", field, 1), getattr(part, field), shape, dtype)


def _check_array(what: str, value: Any, shape: Shape, dtype: type[np.generic] = np.float64) -> None:
    """Check that a field is an array of a shape and type."""
    if not isinstance(value, np.ndarray):
        raise InputError(
            f"{what}: got {_kind(value)}, expected a NumPy array of {_numbers(dtype)} with shape "
            f"{_shape(shape)}"
        )
    if value.dtype != dtype:
        raise InputError(
            f"{what}: got numbers of type {value.dtype}, expected {_numbers(dtype)}. If they are, "
            f"convert them with numpy.asarray(values).astype(numpy.{dtype.__name__})"
        )
    if value.ndim != len(shape) or any(
        expected not in (None, n) for n, expected in zip(value.shape, shape, strict=True)
    ):
        raise InputError(f"{what}: got shape {_shape(value.shape)}, expected {_shape(shape)}")


def _check_finite(what: str, values: Vector, hint: str = "") -> None:
    bad = np.count_nonzero(~np.isfinite(values))
    if bad:
        raise InputError(
            f"{what}: {bad} of {values.size} numbers are NaN or infinite. {hint}".rstrip()
        )


def _check_gaps(what: str, gaps: Vector) -> None:
    bad = np.count_nonzero(np.isnan(gaps) | (gaps == -np.inf))
    if bad:
        raise InputError(
            f"{what}: {bad} of {gaps.size} gaps are NaN or -inf. Where there is nothing to "
            "touch, give +inf"
        )


def _check_range(what: str, numbers: Any, beyond: int) -> None:
    wrong = np.flatnonzero((numbers < 0) | (numbers >= beyond))
    if wrong.size:
        raise InputError(
            f"{what}: {wrong.size} of {numbers.size} numbers are not in [0, {beyond}), the "
            f"first is {numbers[wrong[0]]} at position {wrong[0]}"
        )


def _check_subdomain(name: str, subdomain: Subdomain, gdim: int) -> None:
    body = subdomain.body
    if not isinstance(body, int) or isinstance(body, bool):
        raise InputError(f"body of {name}: got {body!r}, expected an integer")
    if body < 0:
        raise InputError(f"body of {name}: got {body}, expected a number from 0 on")
    _check_kernel(f"kernel of {name}", subdomain)
    nodes, label = subdomain.nodes, f"FIELD of {name}"
    _check_fields(label, subdomain, np.int64, nodes=(None,))
    if nodes.size == 0:
        raise InputError(f"nodes of {name}: there are none. Leave the subdomain out")
    _check_range(f"nodes of {name}", nodes, _LARGEST_NODE)
    distinct, count = np.unique(nodes, return_counts=True)
    if distinct.size < nodes.size:
        raise InputError(
            f"nodes of {name}: {np.count_nonzero(count > 1)} node numbers occur more than once, "
            f"the first is {distinct[count > 1][0]}. Number each node of a subdomain once"
        )
    n = gdim * nodes.size
    _check_fields(label, subdomain, np.float64, coordinates=(nodes.size, gdim), load=(n,))
    _check_finite(f"coordinates of {name}", subdomain.coordinates)
    _check_finite(f"load of {name}", subdomain.load, "Check tractions and body forces")
    _check_format(f"stiffness of {name}", subdomain.stiffness, n)
    if subdomain.load_size is not None:
        _check_fields(label, subdomain, np.float64, load_size=(n,))
    if subdomain.frame is not None:
        _check_fields(label, subdomain, np.float64, frame=(gdim, gdim))
        error = float(np.abs(subdomain.frame @ subdomain.frame.T - np.eye(gdim)).max())
        if not error <= rounding(1.0, GIVEN):
            raise InputError(
                f"frame of {name}: |T T' - I| = {error:.3e}, expected an orthogonal matrix T"
            )


def _check_kernel(what: str, subdomain: Subdomain) -> None:
    """Check the name of the kernel; arrays are checked with the matrix."""
    kernel = subdomain.kernel
    if isinstance(kernel, str) and kernel not in get_args(Kernel):
        raise InputError(f"{what}: got {kernel!r}, expected 'rigid' or 'translations'")
    if not isinstance(kernel, str):
        _check_type(what, kernel, np.ndarray, "'rigid', 'translations' or an array")
        _check_array(what, kernel, (subdomain.load.size, None))
        _check_finite(what, kernel)


def _check_given_motions(what: str, subdomain: Subdomain) -> None:
    """Check the motions of a rigid body."""
    R = subdomain.kernel
    if isinstance(R, str):
        if R != "rigid":
            raise InputError(f"{what}: got {R!r} for a rigid body, expected 'rigid' or an array")
        return
    if subdomain.frame is not None:
        raise InputError(f"{what}: an array is for the coordinates' frame. Leave 'frame' out")
    rigid, lengths = rigid_body_modes(subdomain.coordinates), np.linalg.norm(R, axis=0)
    if np.linalg.matrix_rank(R / np.where(lengths > 0.0, lengths, 1.0), ZERO) < R.shape[1]:
        raise InputError(
            f"{what}: the {R.shape[1]} motions depend on each other. Give independent ones"
        )
    strains = np.linalg.norm(R - rigid @ (rigid.T @ R), axis=0)
    if np.any(strains > NEGLIGIBLE * lengths):
        raise InputError(
            f"{what}: motion {np.argmax(strains / lengths)} deforms the body. Give translations, "
            "rotations and sums of them"
        )


def _check_format(what: str, K: Any, n: int) -> None:
    """Check the kind, shape and structure of a matrix."""
    if not sp.issparse(K):
        raise InputError(
            f"{what}: got {_kind(K)}, expected a scipy.sparse.csr_matrix. Convert it with "
            "scipy.sparse.csr_matrix(K), once for all subdomains that share it"
        )
    if K.format != "csr":
        raise InputError(
            f"{what}: got a matrix in {K.format} format, expected csr. Convert it with K.tocsr(), "
            "once for all subdomains that share it"
        )
    if K.dtype != np.float64:
        raise InputError(
            f"{what}: got numbers of type {K.dtype}, expected float64. If they are real, convert "
            "it with K.astype(numpy.float64)"
        )
    if K.shape != (n, n):
        raise InputError(
            f"{what}: got shape {_shape(K.shape)}, expected {_shape((n, n))}: gdim unknowns for "
            "each node"
        )


def _check_matrix(what: str, subdomain: Subdomain, gdim: int) -> None:
    """Check the entries of a stiffness matrix, and that they connect the subdomain."""
    K = subdomain.stiffness
    try:
        K.check_format(full_check=True)
    except ValueError as error:
        raise InputError(f"{what}: not a valid csr matrix: {error}") from error
    if not K.has_canonical_format:
        raise InputError(
            f"{what}: entries are unsorted or repeated, and the arrays cannot be changed in place. "
            "Give a copy with K.sum_duplicates()"
        )
    hint = "Check the material: lambda is infinite at a Poisson's ratio of 0.5, for example"
    _check_finite(what, K.data, hint)
    if skew := skewness(K):
        largest = np.abs(K.data).max()
        raise InputError(
            f"the bilinear form is not symmetric: {what} has |K - K'| = {skew:.3e} where |K| = "
            f"{largest:.3e}. Contact by minimisation needs a symmetric form a(u, v) = a(v, u). "
            "Pressures that follow the surface, whose tangent is not symmetric, are for "
            "NonlinearContactProblem"
        )
    bad = np.flatnonzero(~(K.diagonal() > 0.0))
    if bad.size:
        raise InputError(
            f"{what}: {bad.size} of {K.shape[0]} diagonal entries are not positive, the first at "
            f"component {bad[0] % gdim} of node {subdomain.nodes[bad[0] // gdim]}. Is the form "
            "elasticity with positive moduli, integrated over all cells, and is every node a "
            "vertex of a cell?"
        )
    _check_connected(what, subdomain, gdim)


def skewness(K: sp.csr_matrix) -> float:
    """Return |K - K'| where that is more than rounding, 0 where K is symmetric."""
    y = 1.0 + np.random.default_rng(0).random(K.shape[0])
    largest = float(np.abs(K.data).max(initial=0.0))
    # most matrices are symmetric, which products tell
    if np.abs(K @ y - K.T @ y).max(initial=0.0) <= rounding(largest, GIVEN):
        return 0.0
    skew = float(np.abs((K - K.T).data).max(initial=0.0))
    return skew if skew > ZERO * largest else 0.0


def _some_neighbours(K: sp.csr_matrix, gdim: int) -> sp.csr_matrix:
    """Return a part of `node_graph`, all of it where K has whole blocks for pairs of nodes."""
    first, end = K.indptr[:-1:gdim], K.indptr[1::gdim]
    counts = -(-(end - first) // gdim)
    offsets = np.append(0, np.cumsum(counts))
    entries = np.arange(offsets[-1]) * gdim + np.repeat(first - gdim * offsets[:-1], counts)
    columns = K.indices[entries] // gdim
    return sp.csr_matrix((np.ones(columns.size), columns, offsets), shape=(first.size, first.size))


def _check_connected(what: str, subdomain: Subdomain, gdim: int) -> None:
    """Check that no part of a subdomain can move rigidly without the rest."""
    K = subdomain.stiffness
    if connected_components(_some_neighbours(K, gdim), directed=False, return_labels=False) == 1:
        return
    pieces, piece = connected_components(node_graph(K, gdim), directed=False)
    if pieces == 1:
        return
    modes = 0
    for number in range(pieces):
        members = np.flatnonzero(piece == number)
        unknowns = unknowns_of_nodes(members, gdim)
        part = Subdomain(
            K[unknowns][:, unknowns],
            subdomain.load[unknowns],
            subdomain.coordinates[members],
            subdomain.nodes[members],
            subdomain.body,
            subdomain.frame,
            subdomain.kernel,
        )
        modes += kernel(part).shape[1]
    if modes > kernel(subdomain).shape[1]:
        raise InputError(
            f"{what}: the subdomain consists of {pieces} parts that no stiffness connects, one of "
            f"them with node {subdomain.nodes[0]} and another with node "
            f"{subdomain.nodes[np.argmax(piece != piece[0])]}. Make each a subdomain of its own"
        )


def _check_prescribed(prescribed: Prescribed, gdim: int) -> None:
    _check_fields("prescribed.FIELD", prescribed, np.int64, nodes=(None,))
    shape = prescribed.nodes.shape
    _check_fields("prescribed.FIELD", prescribed, np.int64, components=shape, condition=shape)
    _check_fields("prescribed.FIELD", prescribed, np.float64, values=shape)
    _check_range("prescribed.nodes", prescribed.nodes, _LARGEST_NODE)
    _check_range("prescribed.components", prescribed.components, gdim)
    _check_range("prescribed.condition", prescribed.condition, _MOST_CONDITIONS)
    _check_finite("prescribed displacements", prescribed.values)


def _check_rows(what: str, rows: ContactRows, gdim: int, names: Sequence[str]) -> None:
    """Check contact or tied rows, whose field of the system is `what`."""
    label = f"{what}.FIELD"
    _check_fields(label, rows, np.float64, gap=(None,))
    k = rows.size
    shapes: dict[str, Shape] = {"nodes": (None,), "offsets": (k + 1,)}
    _check_fields(label, rows, np.int64, contact=(k,), slaves=(k,), **shapes)
    _check_range(f"{what}.contact", rows.contact, np.iinfo(np.int64).max)
    _check_fields(label, rows, np.float64, area=(k,))
    _check_fields(label, rows, np.bool_, held=(k,))
    _check_fields(label, rows, np.float64, compliance=(k, 2))
    _check_fields(label, rows, np.float64, adhesion=(k,))
    _check_compliance(what, rows, names)
    _check_adhesion(what, rows, names)
    if np.any(np.asarray(rows.area) < 0.0) or np.any(np.isinf(np.asarray(rows.area))):
        raise InputError(
            f"{what}.area: an area is finite and at least 0; NaN stands for the length"
        )
    _check_offsets(what, rows, names)
    _check_range(f"{what}.nodes", rows.nodes, _LARGEST_NODE)
    _check_distinct_nodes(what, rows, names)
    _check_fields(label, rows, np.float64, coefficients=(rows.nodes.size, gdim))
    _check_finite(f"{what}.coefficients", rows.coefficients)
    _check_normals(what, rows, names)


def _check_compliance(what: str, rows: ContactRows, names: Sequence[str]) -> None:
    """Check that springs resist, and that rows with springs are contact rows that are not held."""
    pressed, pulled = np.asarray(rows.compliance).T
    wrong = np.flatnonzero(~((pressed >= 0.0) & np.isfinite(pressed) & (pulled >= 0.0)))
    if wrong.size:
        raise InputError(
            f"{what}.compliance: {wrong.size} rows have compliances that are no springs, the first "
            f"is {_row(rows, wrong[0], names)} with {pressed[wrong[0]]:g} where it presses and "
            f"{pulled[wrong[0]]:g} where it pulls. Give numbers from 0 on, the second infinite "
            "where surfaces come apart"
        )
    others = np.flatnonzero(rows.has_springs & (np.asarray(rows.held) | (what == "tied")))
    if others.size:
        raise InputError(
            f"{what}.compliance: {others.size} rows that hold with equality have springs, the "
            f"first is {_row(rows, others[0], names)}. Give springs to contact rows that are not "
            "held"
        )
    apart = np.flatnonzero(np.isfinite(pulled) & ~np.isfinite(rows.gap))
    if apart.size:
        raise InputError(
            f"{what}.compliance: {apart.size} rows have springs that pull over an infinite gap, "
            f"the first is {_row(rows, apart[0], names)}. Give them infinity, or a gap"
        )


def _check_adhesion(what: str, rows: ContactRows, names: Sequence[str]) -> None:
    """Check that adhesion is of contact rows that are neither held nor springs."""
    adhesion = np.asarray(rows.adhesion)
    wrong = np.flatnonzero(~((adhesion >= 0.0) & np.isfinite(adhesion)))
    if wrong.size:
        raise InputError(
            f"{what}.adhesion: {wrong.size} rows have wrong forces, the first is "
            f"{_row(rows, wrong[0], names)} with {adhesion[wrong[0]]:g} N. Give finite numbers "
            "from 0 on"
        )
    others = np.flatnonzero(
        (adhesion > 0.0) & (rows.has_springs | np.asarray(rows.held) | (what == "tied"))
    )
    if others.size:
        raise InputError(
            f"{what}.adhesion: {others.size} rows with springs or that hold with equality adhere, "
            f"the first is {_row(rows, others[0], names)}. Give adhesion to contact rows alone"
        )
    apart = np.flatnonzero((adhesion > 0.0) & ~np.isfinite(rows.gap))
    if apart.size:
        raise InputError(
            f"{what}.adhesion: {apart.size} rows adhere over an infinite gap, the first is "
            f"{_row(rows, apart[0], names)}. Give them 0, or a gap"
        )


def _check_offsets(what: str, rows: ContactRows, names: Sequence[str]) -> None:
    """Check that every row has terms, which follow each other, those of its slave first."""
    offsets, terms, slaves = rows.offsets, rows.nodes.size, np.asarray(rows.slaves)
    if offsets[0] != 0 or offsets[-1] != terms:
        raise InputError(
            f"{what}.offsets: from {offsets[0]} to {offsets[-1]}, but there are {terms} nodes. "
            f"The first has to be 0 and the last {terms}"
        )
    counts = np.diff(offsets)
    descending = np.flatnonzero(counts < 0)
    if descending.size:
        k = descending[0]
        raise InputError(
            f"{what}.offsets: not ascending, from {offsets[k]} to {offsets[k + 1]} in "
            f"{_row(rows, k, names)}. Offsets are positions in {what}.nodes"
        )
    empty = np.flatnonzero(counts == 0)
    if empty.size:
        raise InputError(
            f"{what}.offsets: {empty.size} rows have no terms, the first is "
            f"{_row(rows, empty[0], names)}. Leave them out"
        )
    wrong = np.flatnonzero((slaves < 1) | (slaves > counts))
    if wrong.size:
        raise InputError(
            f"{what}.slaves: {wrong.size} rows have other numbers than 1 to that of their terms, "
            f"the first is {_row(rows, wrong[0], names)} with {slaves[wrong[0]]}"
        )


def _check_distinct_nodes(what: str, rows: ContactRows, names: Sequence[str]) -> None:
    """Check that no row names a node twice, but one that is on both surfaces beside its slave."""
    order = np.lexsort((rows.on_slave, rows.nodes, rows.row))
    row, node, on_slave = rows.row[order], rows.nodes[order], rows.on_slave[order]
    on_both = (on_slave[1:] != on_slave[:-1]) & (node[1:] != rows.slave[row[1:]])
    repeats = np.flatnonzero((row[1:] == row[:-1]) & (node[1:] == node[:-1]) & ~on_both)
    if repeats.size:
        raise InputError(
            f"{what}.nodes: {np.unique(row[repeats]).size} rows name a node twice, the "
            f"first is {_row(rows, row[repeats[0]], names)} with node {node[repeats[0]]}. Add up "
            "the coefficients, or leave out rows whose slave is its own master"
        )


def _check_normals(what: str, rows: ContactRows, names: Sequence[str]) -> None:
    """Check that every row has a normal: the direction of the sum of its slave's coefficients."""
    largest, length = np.zeros(rows.size), rows.length
    np.maximum.at(largest, rows.row, np.linalg.norm(rows.coefficients, axis=1))
    vanishing = np.flatnonzero(length <= rounding(largest, GIVEN))
    if vanishing.size:
        k = vanishing[0]
        raise InputError(
            f"{what}.coefficients: the sum of the slave's coefficients vanishes in "
            f"{vanishing.size} rows, the first is {_row(rows, k, names)} at slave node "
            f"{rows.slave[k]} with a sum of length {length[k]:.3e} and coefficients of up to "
            f"{largest[k]:.3e}. The slave's terms come first and add up to a vector along the "
            "normal; leave other rows out"
        )


def _check_friction(friction: Friction, contacts: ContactRows, gdim: int) -> None:
    """Check friction against the contact rows of this rank, which have been checked."""
    _check_fields("friction.FIELD", friction, np.int64, row=(None,))
    rows, directions = friction.row.size, gdim - 1
    shapes = {
        "tangents": (rows, directions, gdim),
        "bound": (rows,),
        "slip": (rows, directions),
        "coefficient": (rows,),
        "compliance": (rows,),
    }
    _check_fields("friction.FIELD", friction, np.float64, **shapes)
    _check_range("friction.row", friction.row, contacts.size)
    if np.any(np.diff(friction.row) <= 0):
        raise InputError("friction.row: positions must ascend, each contact row once")
    # springs along the surface have no bound
    springs = (friction.bound == np.inf) & (np.asarray(friction.compliance) > 0.0)
    for field in shapes:
        values = getattr(friction, field)
        values = np.where(springs, 0.0, values) if field == "bound" else values
        _check_finite(f"friction.{field}", values)
    for field, unit, meaning in (
        ("bound", " N", "slip bound"),
        ("coefficient", "", "coefficient of friction"),
        ("compliance", " m/N", "compliance"),
    ):
        values = getattr(friction, field)
        if np.any(values < 0.0):
            k = np.argmin(values)
            raise InputError(
                f"friction.{field}: {values[k]:g}{unit} at position {k}; a {meaning} is at least 0"
            )
    frame = np.concatenate([friction.tangents, contacts.normal[friction.row][:, None]], axis=1)
    error = np.abs(frame @ frame.transpose(0, 2, 1) - np.eye(gdim)).max(axis=(1, 2), initial=0.0)
    if np.any(error > _NOT_ORTHONORMAL):
        k = np.argmax(error)
        raise InputError(
            f"friction.tangents: at position {k} tangents and normal are not orthonormal: "
            f"their products differ by {error[k]:g} from the identity. Give unit tangents that "
            "are orthogonal to each other and to the normal of the contact row"
        )


def _row(rows: ContactRows, row: int, names: Sequence[str]) -> str:
    """Name a row by its position and its contact."""
    contact = int(rows.contact[row])
    return f"row {row} ({names[contact] if contact < len(names) else f'contact {contact}'})"


def _name(system: TornSystem, number: int) -> str:
    rank = f" of rank {system.comm.rank}" if system.comm.size > 1 else ""
    return f"subdomain {number}{rank} ({system.body_name(system.subdomains[number].body)})"


def _kind(value: Any) -> str:
    name = type(value).__name__
    shape = getattr(value, "shape", None)
    return f"{name} of shape {_shape(shape)}" if isinstance(shape, tuple) and shape else name


def _numbers(dtype: type[np.generic]) -> str:
    words = {np.int64: "integers (int64)", np.bool_: "truth values (bool)"}
    return words.get(dtype, "numbers (float64)")


def _shape(shape: Shape) -> str:
    """Write a shape; k stands for any length."""
    inside = ", ".join("k" if n is None else str(n) for n in shape)
    return f"({inside},)" if len(shape) == 1 else f"({inside})"
