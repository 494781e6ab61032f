"""Products with F that friction takes, beside the same problem without friction.

A cube is pressed and pushed on another one by moving its top; each is cut into blocks of equal
size, so that H/h stays while h falls. Run it by ``python benchmarks/friction.py``.
"""

from __future__ import annotations

import argparse

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem

from fenics_tfeti import ContactPair, ContactProblem, Coulomb, Tresca
from fenics_tfeti.io import Box, boxes, displacement_space, tag_facets


def cubes(n, friction, move, rtol, preconditioner):
    """Return two cubes of n^3 hexahedra, with 4^3 of them in each subdomain."""
    parts = [Box((0, 0, 0), (1, 1, 1), (n, n, n)), Box((0, 0, -1), (1, 1, 0), (n, n, n))]
    tagged = boxes(MPI.COMM_WORLD, parts)
    mesh = tagged.mesh
    markers = [
        (1, lambda x: np.isclose(x[2], 1)),
        (2, lambda x: np.isclose(x[2], -1)),
        (5, lambda x: np.isclose(x[2], 0), 1),
        (6, lambda x: np.isclose(x[2], 0), 2),
    ]
    tags = tag_facets(mesh, markers, tagged.cell_tags)
    V = displacement_space(mesh)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    strain = ufl.sym(ufl.grad(u))
    a = (0.77 * ufl.inner(strain, ufl.grad(v)) + 0.58 * ufl.div(u) * ufl.div(v)) * ufl.dx
    top, bottom = (fem.locate_dofs_topological(V, 2, tags.find(tag)) for tag in (1, 2))
    supports = [
        fem.dirichletbc(np.array(move), top, V),
        fem.dirichletbc(np.zeros(3), bottom, V),
    ]
    pair = ContactPair(tags, slave=5, master=6, friction=friction)
    options = {"rtol": rtol, "preconditioner": preconditioner, "subdomain_size": 375}
    return ContactProblem(a, 0, supports, [pair], tagged.cell_tags, options=options)


def main():
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--divisions", type=int, nargs="+", default=[4, 8, 12])
    parser.add_argument("--rtol", type=float, default=1e-6)
    parser.add_argument("--preconditioner", default="lumped")
    given = parser.parse_args()
    laws = {
        "none": None,
        "Tresca, some slip": Tresca(1.2e-3),
        "Tresca, all slip": Tresca(5e-4),
        "Coulomb, some slip": Coulomb(0.1),
        "Coulomb, all slip": Coulomb(0.05),
    }
    print("law                 n   subdomains  products  of none   stick        steps  outer")
    for n in given.divisions:
        without = 0
        for name, law in laws.items():
            problem = cubes(n, law, (0.01, 0.003, -0.02), given.rtol, given.preconditioner)
            problem.solve()
            report = problem.report
            products = report.products["total"]
            without = without or products
            unknowns = report.unknowns
            if MPI.COMM_WORLD.rank == 0:
                stick = f"{unknowns['sticking']} of {unknowns['friction']}"
                print(
                    f"{name:18}{n:3}  {report.subdomains:10}  {products:8}  "
                    f"{products / without:7.2f}   {stick:11}  {len(report.slip_bounds):5}  "
                    f"{report.outer_iterations:5}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
