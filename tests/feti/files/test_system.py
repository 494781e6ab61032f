"""Torn systems written and read again."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from sparse_rows import distributed
from torn import column

from fenics_tfeti import InputError
from fenics_tfeti.feti import (
    ContactRows,
    Friction,
    Options,
    TornSolver,
    TornSystem,
    load_system,
    save_system,
)
from fenics_tfeti.feti.__main__ import main

COMM = MPI.COMM_WORLD
DISTRIBUTED = distributed(column(height=3), COMM)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "system.npz"


def everything() -> TornSystem:
    """Return a system in which every field of every part has other values than by default."""
    system = column(n=2, height=2)
    rows, second = system.contacts, 10**9
    upper = system.subdomains[-1]
    upper = dataclasses.replace(upper, frame=np.eye(3)[[1, 2, 0]], load_size=2.0 + upper.load**2)
    side = upper.nodes[np.isclose(upper.coordinates[:, 2], 2.5)][:2]
    tied = ContactRows.node_to_node(side, [-1, -1], np.tile([1.0, 0, 0], (2, 1)), [0, 0], [1, 1])
    is_held = np.arange(rows.size) == 1
    two = dataclasses.replace(
        rows,
        gap=np.append(rows.gap[:-1], np.inf),
        held=is_held,
        adhesion=1.0 * (np.arange(rows.size) == 0),
        compliance=np.column_stack([0.5 * (np.arange(rows.size) > 1), np.full(rows.size, np.inf)]),
    )
    rubbing = np.arange(0, rows.size, 2)
    tangents = np.tile([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], (rubbing.size, 1, 1))
    friction = Friction(
        rubbing,
        tangents,
        0.1 + rubbing,
        1e-3 * np.ones((rubbing.size, 2)),
        compliance=0.5 * rubbing,
    )
    condition = (system.prescribed.nodes >= second).astype(np.int64)
    return dataclasses.replace(
        system,
        subdomains=[*system.subdomains[:-1], upper],
        contacts=two,
        tied=tied,
        friction=friction,
        prescribed=dataclasses.replace(system.prescribed, condition=condition),
        contact_names=["joint", "tie"],
        condition_names=["bottom", "top"],
    )


def assert_same(one, other):
    """Compare data classes, lists and arrays of any depth."""
    assert type(one) is type(other)
    if dataclasses.is_dataclass(one):
        for f in dataclasses.fields(one):
            if f.name != "comm":
                assert_same(getattr(one, f.name), getattr(other, f.name))
    elif isinstance(one, list):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif hasattr(one, "toarray"):
        assert_same(one.toarray(), other.toarray())
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


def test_round_trip(path):
    system = everything()
    save_system(path, system)
    assert_same(load_system(path), system)


def test_solution_is_the_same_to_the_last_bit(path):
    system = column(load=(0.1, 0, -1.0))
    save_system(path, system)
    one, other = (TornSolver(s, Options(rtol=1e-8)).solve() for s in (system, load_system(path)))
    np.testing.assert_array_equal(one.multipliers, other.multipliers)
    assert [c.normal_force for c in one.report.contacts] == [
        c.normal_force for c in other.report.contacts
    ]


def test_shared_matrices_stay_shared(path):
    """As subdomains that share their matrix share its factor."""
    system = column(n=2, height=3)
    K = system.subdomains[0].stiffness
    shared = [dataclasses.replace(s, stiffness=K) for s in system.subdomains]
    save_system(path, dataclasses.replace(system, subdomains=shared))
    read = load_system(path).subdomains
    assert len(read) == 4 and len({id(s.stiffness) for s in read}) == 1
    assert sum("matrices" in name for name in np.load(path).files) == 3


@pytest.mark.parametrize("contact", [True, False])
def test_optional_arrays_may_be_left_out(path, contact):
    save_system(path, column(n=2, contact=contact))
    left_out = ("tied/", "friction/", "names/", "prescribed/condition")
    if not contact:
        left_out += ("contacts/", "prescribed/")
    arrays = {n: a for n, a in np.load(path).items() if not n.startswith(left_out)}
    np.savez(path, **arrays)
    system = load_system(path)
    assert system.body_names == [] and system.tied.size == 0
    assert bool(system.contacts.size) == bool(system.prescribed.nodes.size) == contact
    assert not contact or TornSolver(system).solve().report.converged


WRONG = [
    ("gdim", np.array(4), "'gdim' is 4"),
    ("gdim", np.array(3.0), "'gdim' is of type float64, expected integers"),
    ("subdomains/1/load", None, "'subdomains/1/load' is missing"),
    ("subdomains/1/load", np.zeros(5), r"'subdomains/1/load' has shape \(5,\)"),
    ("subdomains/1/nodes", np.arange(3), "27 nodes|3 nodes"),
    ("subdomains/4/nodes", np.arange(3), "'subdomains/3' is missing"),
    ("subdomains/0/matrix", np.array(9), "'matrices/9/indptr' is missing"),
    ("matrices/0/data", np.zeros(2), "'matrices/0/data' has shape"),
    ("matrices/0/indptr", np.arange(82)[::-1].copy(), "'matrices/0' is not a csr matrix"),
    ("contacts/offsets", np.zeros(10, dtype=int), "'contacts/offsets' has to begin with 0"),
    ("friction/row", np.arange(4, 14, 2), "'friction/row' has 10, but there are 9 contact rows"),
    ("contacts/gaps", np.zeros(9), "no array 'contacts/gaps' .* mean 'contacts/gap'"),
    ("subdomains/x/load", np.zeros(9), "no array 'subdomains/x/load'"),
    ("names/bodies", np.arange(2), "'names/bodies' is of type int64, expected strings"),
    ("format", np.array("something else"), "the format is 'something else'"),
]


@pytest.mark.parametrize(("name", "value", "message"), WRONG)
def test_wrong_array_is_named(path, name, value, message):
    save_system(path, everything())
    arrays = dict(np.load(path))
    arrays.pop(name, None)
    if value is not None:
        arrays[name] = value
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=message) as caught:
        load_system(path)
    assert str(path) in str(caught.value)


def test_wrong_system_is_not_written(path):
    system = column(n=2)
    load = np.full(system.subdomains[0].size, np.nan)
    wrong = [dataclasses.replace(system.subdomains[0], load=load), *system.subdomains[1:]]
    with pytest.raises(InputError, match="NaN"):
        save_system(path, dataclasses.replace(system, subdomains=wrong))
    assert not path.exists()


@pytest.mark.ranks(2)
def test_file_of_many_ranks_read_by_one_and_by_many(shared_folder):
    exact = TornSolver(column(height=3), Options(rtol=1e-9)).solve().report
    save_system(shared_folder / "system.npz", DISTRIBUTED)
    COMM.barrier()
    for comm in (MPI.COMM_SELF, COMM):
        system = load_system(shared_folder / "system.npz", comm)
        counts = comm.allgather((len(system.subdomains), system.contacts.size))
        assert [sum(count) for count in zip(*counts, strict=True)] == [4, 16]
        assert max(count[0] for count in counts) <= -(-4 // comm.size)
        report = TornSolver(system, Options(rtol=1e-9)).solve().report
        assert [c.normal_force for c in report.contacts] == pytest.approx(
            [c.normal_force for c in exact.contacts], rel=1e-8
        )
        assert report.energy == pytest.approx(exact.energy, rel=1e-8)


@pytest.mark.ranks(2)
def test_errors_reach_all_ranks(shared_folder):
    with pytest.raises(OSError, match="torn system cannot be written"):
        save_system(shared_folder / "missing" / "system.npz", DISTRIBUTED)
    with pytest.raises(FileNotFoundError):
        load_system(shared_folder / "system.npz", COMM)
    # too few subdomains for the last rank to read any: the error is that of another one
    if COMM.rank == 0:
        system = column(n=2, contact=False)
        save_system(shared_folder / "system.npz", replace(system, subdomains=system.subdomains[:1]))
        arrays = dict(np.load(shared_folder / "system.npz"))
        del arrays["subdomains/0/load"]
        np.savez(shared_folder / "system.npz", **arrays)
    COMM.barrier()
    with pytest.raises(InputError, match="'subdomains/0/load' is missing"):
        load_system(shared_folder / "system.npz", COMM)


@pytest.mark.ranks(2)
def test_command(shared_folder, capfd):
    save_system(shared_folder / "system.npz", DISTRIBUTED)
    COMM.barrier()
    command = [str(shared_folder / "system.npz"), "--rtol", "1e-9"]
    assert main([*command, "--solution", str(shared_folder / "solution.npz")], COMM) == 0
    assert main([*command, "--max_products", "1"], COMM) == 1
    assert main([*command, "--method", "none"], COMM) == 2
    COMM.barrier()
    printed = capfd.readouterr()
    assert ("force on slave  (0, 0, 1) of 'joint'" in printed.out) == (COMM.rank == 0)
    assert ("error: option 'method'" in printed.err) == (COMM.rank == 0)
    solution = dict(np.load(shared_folder / "solution.npz"))
    exact = TornSolver(column(height=3), Options(rtol=1e-9)).solve()
    assert solution["normal_force"].sum() == pytest.approx(1.0, rel=1e-8)
    nodes = np.concatenate([s.nodes for s in column(height=3).subdomains])
    u = np.concatenate(exact.displacements).reshape(-1, 3)
    at = np.searchsorted(solution["nodes"], nodes)
    np.testing.assert_array_equal(solution["nodes"][at], nodes)
    size = np.abs(u).max()
    np.testing.assert_allclose(solution["displacement"][at], u, atol=1e-7 * size)
