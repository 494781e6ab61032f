"""A fork, a lug and a pin with clearance on tetrahedra of Gmsh: what a first joint gives.

    python benchmarks/run.py joint [--element-size 1.5] [--degree 1] [--exchange]
        [--initial-gap 0.02]

The lug is pulled by 5,292 N, the pin is loose, nothing has friction; lengths in mm, forces in N.
A row for each contact has the largest pressure, and how far lug and pin they move along the pin.
Processor time is that from the forms to the displacement, without Gmsh; a first run compiles forms.
"""

from __future__ import annotations

from time import process_time

from joints import axial_motion, joint_problem, read_joint

CHOICES = {"degree": [1, 2]}


def run(element_size=1.5, degree=1, exchange=False, initial_gap=-1.0):
    """Run one case: `exchange` makes the pin the slave, a clearance below 0 is the mesh's [mm]."""
    bodies = read_joint(element_size, degree)
    of_pair = {} if initial_gap < 0.0 else {"initial_gap": initial_gap}
    begin = process_time()
    problem = joint_problem(bodies, degree, exchange, **of_pair)
    uh = problem.solve()
    seconds, motion = process_time() - begin, axial_motion(bodies, uh)
    for contact in problem.results:
        result = contact.gather()
        yield {
            "contact": result.name,
            "largest pressure [MPa]": float(result.pressure.max()),
            "nodes that press": int(result.active.sum()),
            "unknowns": problem.report.unknowns["primal"],
            "processor seconds": seconds,
            "products": problem.report.products["total"],
            "along the pin [mm]": motion,
        }
