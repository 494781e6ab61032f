from __future__ import annotations

import numpy as np
import pytest
from fibres import reinforced_block
from torn import column

from fenics_tfeti.feti import Options, TornSolver, TornSystem
from fenics_tfeti.feti.coarse.material_jumps import subdomains_with_jumps


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


def test_stiff_subdomains_do_not_count():
    """A jump between subdomains is what weights of stiffness are for."""
    system = column(n=2, height=3)
    for s in system.subdomains[::2]:
        s.stiffness.data *= 1e6
    assert not any(jumps(system))
