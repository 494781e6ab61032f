"""Memory: solve after solve in a process of its own, and the peak of a solve with new materials."""

import json

import pytest
from new_process import run_python

from fenics_tfeti.feti.factors.cholesky import available_packages

pytestmark = pytest.mark.once

MEASURE = """
import ctypes, gc, json, resource, sys
from mpi4py import MPI
import fenics_tfeti, scenes, ufl

def resident_bytes():
    # free memory that the C library keeps would hide small leaks, or look like some
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()
"""

GROWTH = (
    MEASURE
    + """
method, factor = sys.argv[1:3]
n, warm_up, solves = map(int, sys.argv[3:])
scene = scenes.two_beams(MPI.COMM_SELF, "hexahedron", n, gap=1e-3)
young, traction = scene.young, scene.traction
options = {"method": method, "rtol": 1e-3, "subdomain_size": 100 * n, "factor": factor}
obstacle = fenics_tfeti.Sphere((2.5, 0.5, -10.0), 10.0)
height = [0.0]

def ground(x):
    gap, normal = obstacle(x)
    return gap + height[0], normal

def posed():
    from fenics_tfeti import RigidObstacle
    on_ground = RigidObstacle(scene.facet_tags, scenes.SLAVE, ground)
    contacts = [*scene.contacts, on_ground]
    return scene.problem(contacts=contacts, options=options)

problem = posed()

def solve(kind, step):
    global problem
    factor = 1.0 + 0.01 * (step % 7)
    if kind == "loads and gaps":
        traction.value, height[0] = -scenes.TRACTION * factor, 1e-4 * (step % 5)
    elif kind == "stiffness":
        young.value = scenes.YOUNG * factor
    else:
        problem = posed()
    problem.solve()

growth = {}
for kind in ("loads and gaps", "stiffness", "new problem"):
    for step in range(warm_up):
        solve(kind, step)
    before = resident_bytes()
    for step in range(solves):
        solve(kind, step)
    growth[kind] = resident_bytes() / before - 1.0
assert problem.report.subdomains > 1
print(json.dumps(growth))
"""
)


@pytest.mark.parametrize(
    ("n", "method", "warm_up", "solves", "limit"),
    [
        (2, "active_set", 5, 12, 0.003),
        *(
            pytest.param(n, method, 60, 100, 0.01, marks=pytest.mark.heavy)
            for n in (3, 8)
            for method in ("active_set", "smalbe")
        ),
    ],
)
@pytest.mark.timeout(3600)
def test_solves_do_not_make_the_process_larger(n, method, warm_up, solves, limit):
    """With other loads and gaps, with another stiffness, and as new problems."""
    # rslab has an allocator of its own, which keeps up to 2 % of the process for a while
    factor = next(package for package in available_packages() if package != "rslab")
    arguments = method, factor, str(n), str(warm_up), str(solves)
    growth = json.loads(run_python(GROWTH, *arguments, timeout=3600).splitlines()[-1])
    assert max(growth.values()) < limit, growth


PEAK = (
    MEASURE
    + """
scene = scenes.two_beams(MPI.COMM_SELF, "tetrahedron", int(sys.argv[1]))
u, v = ufl.TrialFunction(scene.V), ufl.TestFunction(scene.V)
# not translation invariant: no subdomains share their stiffness
young = scene.young * (1.0 + 0.01 * ufl.SpatialCoordinate(scene.mesh)[0])
scene.a = scenes.elasticity(u, v, young)

def peak_of(action):
    before = resident_bytes()
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")  # forget the peak so far
    action()
    with open("/proc/self/status") as file:
        (peak,) = (line.split()[1] for line in file if line.startswith("VmHWM"))
    return 1024 * int(peak) - before

def pose():
    global problem
    problem = scene.problem()
    problem.solve()

peaks = [peak_of(pose)]
for _ in range(2):
    scene.young.value *= 1.1
    peaks.append(peak_of(problem.solve))
print(json.dumps(peaks))
"""
)


def test_changed_stiffness_takes_the_place_of_the_last_one():
    """Two sets of factors at once would double what a problem takes."""
    first, *changed = json.loads(run_python(PEAK, "10").splitlines()[-1])
    assert first > 20e6
    assert max(changed) < 0.4 * first
