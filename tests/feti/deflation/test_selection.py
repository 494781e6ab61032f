from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fibres import FAR, reinforced_block, subdomain
from torn import column, fixed_nodes

from fenics_tfeti.feti import ContactRows, Options, TornSolver, TornSystem
from fenics_tfeti.feti.deflation.local_spectra import threshold
from fenics_tfeti.feti.deflation.selection import (
    subdomains_with_jumps,
    trial_eigenvalue,
    weights_of_equality_rows,
)
from fenics_tfeti.feti.local.trial_displacements import TrialDisplacements

pytestmark = pytest.mark.once


def jumps(system: TornSystem) -> list[bool]:
    """Return for each subdomain whether the stiffness jumps on its interface."""
    setup = TornSolver(system, Options(deflation="off")).setup
    found = subdomains_with_jumps(
        system, setup.constraints, setup.F.interface, setup.local.unknowns
    )
    members = np.concatenate([c.members for c in setup.local.classes])
    return [bool(found[np.flatnonzero(members == s)[0]]) for s in range(len(system.subdomains))]


@pytest.mark.parametrize("ratio", [1e-6, 1e-2, 200.0, 1e6])
@pytest.mark.parametrize("gdim", [2, 3])
def test_fibres_that_are_cut(gdim, ratio):
    # thick enough that some nodes lie within the fibres
    system = reinforced_block(gdim, ratio, n=8)
    assert jumps(system) == [s.body == 0 for s in system.subdomains]


@pytest.mark.parametrize("ratio", [0.2, 1.0, 5.0])
def test_nearly_uniform_material(ratio):
    assert not any(jumps(reinforced_block(2, ratio)))


def test_a_gradual_change_does_not_count():
    """The modulus of two blocks grows by half from element to element, over the whole by 1300."""
    blocks = [subdomain((18 * i, 0), (18, 2), lambda x: 1.5 ** x[:, 0], i) for i in (0, 1)]
    left = replace(blocks[1], nodes=blocks[1].nodes - FAR**2, body=0)
    bottom = np.flatnonzero(left.coordinates[:, 1] == 0.0)
    fixed = fixed_nodes(left.nodes[bottom], [0, 1])
    system = TornSystem([blocks[0], left], fixed, ContactRows.none(2), 2, ["block"])
    weights = left.stiffness.diagonal()[::2][bottom]
    assert weights.max() > 500.0 * weights.min()
    assert jumps(system) == [False, False]


def test_stiff_subdomains_do_not_count():
    """A jump between subdomains is what weights of stiffness are for."""
    system = column(n=2, height=3)
    for s in system.subdomains[::2]:
        s.stiffness.data *= 1e6
    assert not any(jumps(system))


@pytest.mark.parametrize(("length", "flexible"), [(4, False), (60, True)])
def test_slender_subdomains(length, flexible):
    """Three layers glued along their long sides: those whose ends are free bend easily."""
    layers = [subdomain((0, 4 * i), (length, 4), lambda x: np.ones(len(x)), i) for i in range(3)]
    glued = [replace(s, nodes=s.nodes - i * FAR**2, body=0) for i, s in enumerate(layers)]
    bottom = glued[0].nodes[glued[0].coordinates[:, 1] == 0.0]
    system = TornSystem(glued, fixed_nodes(bottom, [0, 1]), ContactRows.none(2), 2, ["block"])
    setup = TornSolver(system, Options(deflation="on")).setup
    interface = setup.F.interface
    weights = weights_of_equality_rows(setup.constraints, interface, setup.local.unit)
    kernels = setup.local.on_interface(interface)
    for congruent, K, unknowns, D, R in zip(
        interface.classes,
        setup.local.stiffness,
        interface.unknowns,
        interface.blocks(weights),
        kernels,
        strict=True,
    ):
        part = glued[congruent.first]
        trial = TrialDisplacements.build(K, part.coordinates, unknowns)
        assert (trial_eigenvalue(trial, D, R) > threshold(2, part.nodes.size)) == flexible
    assert (setup.deflation is not None) == flexible
    assert (TornSolver(system).setup.deflation is not None) == flexible
