"""Products with F that friction takes, beside the same problem without friction.

    python benchmarks/run.py friction [--scene cubes|plate|belt|grains|packing] [--divisions 4 8 12]

A cube is pressed and pushed on another one by moving its top; each is cut into blocks of equal
size, so that H/h stays while h falls. A plate on a rigid plane is pulled at one end. A belt,
divided once across, is pulled over a drum. Irregular grains in a box are pressed by a piston, and
discs with radii that differ by up to a ten-thousandth lie in one; divisions are the number of
grains and that of discs in a row.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from friction_scenes import belt, pulled_plate
from granular import grains, packing
from scenes import Scene, at

import ufl

from fenics_tfeti import Coulomb, Tresca

# laws of each scene and divisions; those of belt, grains and packing are coefficients
SCENES = {
    "cubes": (
        {
            "none": None,
            "Tresca, some slip": Tresca(1.2e-3),
            "Tresca, all slip": Tresca(5e-4),
            "Coulomb, some slip": Coulomb(0.1),
            "Coulomb, all slip": Coulomb(0.05),
        },
        [4, 8, 12],
    ),
    "plate": (
        {
            "none": None,
            "Tresca, half slips": Tresca(1e-3),
            "Tresca, all slip": Tresca(2e-4),
            "Coulomb, half slips": Coulomb(1.0),
            "Coulomb, all slip": Coulomb(0.2),
        },
        [4, 8, 12],
    ),
    "belt": ({"none": None, "Coulomb 0.3": 0.3, "Coulomb 0.6": 0.6}, [60]),
    "grains": (
        {"none": None, "Coulomb 0.2": 0.2, "Coulomb 0.3": 0.3, "Coulomb 0.5": 0.5},
        [12, 25, 50],
    ),
    "packing": ({"none": None, "Coulomb 0.1": 0.1, "Coulomb 0.3": 0.3, "Coulomb 0.6": 0.6}, [3, 6]),
}


def problem_of(scene, n, law):
    """Return the problem of a scene with its own tolerance."""
    if scene == "cubes":
        return cubes(n, law, (0.01, 0.003, -0.02))
    if scene == "grains":
        return grains(n, 0.3 / np.sqrt(n), law, MPI.COMM_WORLD)
    if scene == "packing":
        return packing(n, n, 1e-4, law, MPI.COMM_WORLD)
    return pulled_plate(law, n) if scene == "plate" else belt(n, law).problem


def cubes(n, friction, move):
    """Return two cubes of n^3 hexahedra, with 4^3 of them in each subdomain."""
    parts = [((0, 0, z), (1, 1, z + 1), (n, n, n)) for z in (0, -1)]
    marks = [(1, at(2, 1)), (2, at(2, -1)), (5, at(2, 0), 1), (6, at(2, 0), 2)]
    cubes = Scene.of_boxes(MPI.COMM_WORLD, "hexahedron", parts, marks)
    u, v = cubes.u, cubes.v
    strain = ufl.sym(ufl.grad(u))
    cubes.a = (0.77 * ufl.inner(strain, ufl.grad(v)) + 0.58 * ufl.div(u) * ufl.div(v)) * ufl.dx
    cubes.fix(1, None, np.array(move))
    cubes.fix(2)
    cubes.add_pair(5, 6, friction=friction)
    return cubes.problem(options={"rtol": 1e-6, "subdomain_size": 375})


CHOICES = {"scene": list(SCENES)}


def run(scene="cubes", divisions=(0,)):
    """Solve a scene with each law; 0 divisions are those of the scene."""
    laws, usual = SCENES[scene]
    for n in usual if divisions == (0,) else divisions:
        without = 0
        for name, law in laws.items():
            problem = problem_of(scene, n, law)
            problem.solve()
            report, unknowns = problem.report, problem.report.unknowns
            products = report.products["total"]
            without = without or products
            yield {
                "law": name,
                "n": n,
                "subdomains": report.subdomains,
                "products": products,
                "of none": products / without,
                "stick": f"{unknowns['sticking']} of {unknowns['friction']}",
                "steps": len(report.slip_bounds),
                "outer": report.outer_iterations,
            }
