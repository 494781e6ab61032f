"""Contact of unstructured tetrahedra compared with a linear solve of the same mesh, glued.

    python benchmarks/run.py general [--elements-per-metre 21 35] [--residual 1e-4 1e-6]
        [--ranks 1 2] [--option subdomain_size=6000 ...]

The two beams of demos/two_beams.py by ContactProblem with its default subdomains, and the same mesh
with coincident nodes merged (a linear problem) by dolfinx's assembly and PETSc's CG with GAMG. Each
solve runs in its own processes with one thread per rank. Seconds are from the mesh and the forms to
the displacement, after a solve of a small mesh has compiled the forms.

Both are required to reach the same true relative residual, ||b - Ax|| / ||b|| of the assembled
matrix without supported unknowns and contact forces. CG stops at it. ContactProblem stops when its
bound of the error in the energy norm is below its rtol. The forces that this error makes are larger
in proportion; rtol is therefore RTOL_FACTOR times the required residual. The residual is computed
after the solve, and printed.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from pathlib import Path
from typing import Any

from mpi4py import MPI

from petsc4py import PETSc

import numpy as np
from runner import separately
from scenes import Scene

from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc

from fenics_tfeti import ContactProblem
from fenics_tfeti.feti import Timer
from fenics_tfeti.feti.report.report import peak_memory
from fenics_tfeti.io import TaggedMesh, read_msh

CHOICES = {"only": ["contact", "glued"]}
CONTACT = ("contact_upper", "contact_lower")
SUPPORTED = [("clamped", 0), ("clamped", 1), ("clamped", 2), ("guided", 0), ("guided", 1)]
# At 0.1 million unknowns no combination of thresholds from 0 to 0.05, 0 to 2 aggressive levels and
# 1 to 4 smoothing steps is more than 6 % faster. Without an aggressive level the solve takes four
# to five times as long.
GAMG = {
    "pc_gamg_type": "agg",
    "pc_gamg_agg_nsmooths": 1,
    "pc_gamg_threshold": 0.01,
    "pc_gamg_aggressive_coarsening": 1,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_ksp_max_it": 2,
    "mg_levels_pc_type": "jacobi",
}
WARM_UP = 4  # elements per metre
# the residual of the assembled matrix is up to 26 times rtol, which bounds the error in the energy
RTOL_FACTOR = 0.03


class Beams:
    """Forms and supports as in demos/two_beams.py, on the mesh of two bodies or the glued one."""

    def __init__(self, tagged: TaggedMesh) -> None:
        self.tags, self.scene = tagged.names, Scene.of(tagged)
        self.scene.add_load(self.tags["loaded"], np.array([0.0, 0.0, -20e6]))
        for surface, component in SUPPORTED:
            self.scene.fix(self.tags[surface], component)
        self.fixed = np.unique(np.concatenate([self.dofs(*where) for where in SUPPORTED]))

    def dofs(self, surface: str, component: int) -> Any:
        """Return the degrees of freedom of one component on a surface."""
        facets = self.scene.facet_tags.find(self.tags[surface])
        return fem.locate_dofs_topological(self.scene.V.sub(component), 2, facets)

    def contact(self, **options: Any) -> ContactProblem:
        """Return the problem of the two bodies."""
        self.scene.add_pair(*(self.tags[name] for name in CONTACT))
        return self.scene.problem(cell_tags=None, options=options)

    def stiffness(self) -> PETSc.Mat:
        """Assemble the stiffness, with ones on the diagonal at supports."""
        A = fem_petsc.assemble_matrix(fem.form(self.scene.a), bcs=self.scene.bcs)
        A.assemble()
        return A

    def load(self) -> PETSc.Vec:
        """Assemble the load; zero at the supports."""
        b = fem_petsc.assemble_vector(fem.form(self.scene.L))
        b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        self.clear(b, self.fixed)
        return b

    @staticmethod
    def clear(b: PETSc.Vec, dofs: Any) -> None:
        """Set components to zero, those that this rank owns."""
        b.array_w[dofs[dofs < b.getLocalSize()]] = 0.0


def relative_residual(A: PETSc.Mat, x: PETSc.Vec, b: PETSc.Vec, without: Any) -> float:
    """Return ||b - Ax|| / ||b|| without some components."""
    r = b.duplicate()
    A.mult(x, r)
    r.aypx(-1.0, b)
    Beams.clear(r, without)
    return float(r.norm() / b.norm())


def solve_contact(path: Path, rtol: float, options: dict[str, str]) -> dict[str, Any]:
    """Solve by ContactProblem; return a row of the table."""
    beams = Beams(read_msh(path))
    comm = beams.scene.mesh.comm
    before = peak_memory(comm)
    begin = _now(comm)
    problem = beams.contact(rtol=rtol, **options)
    uh = problem.solve()
    seconds, processor = _now(comm) - begin
    report = problem.report
    A = beams.stiffness()
    x = A.createVecRight()
    x.array_w[:] = uh.x.array[: x.getLocalSize()]
    # the normal is along z
    left_out = np.concatenate([beams.fixed, *(beams.dofs(name, 2) for name in CONTACT)])
    return {
        "unknowns": report.unknowns["primal"],
        "torn": report.unknowns["torn"],
        "dual": report.unknowns["dual"],
        "subdomains": report.subdomains,
        "products": report.products,
        "seconds": seconds,
        "processor seconds": processor,
        "phases": {**report.seconds, "total": seconds},
        "bytes": report.peak_memory_bytes,
        "bytes before": before,
        "residual": relative_residual(A, x, beams.load(), left_out),
        "certificate": report.to_dict()["certificate"],
        "force": report.contacts[0].normal_force,
    }


def solve_glued(path: Path, rtol: float) -> dict[str, Any]:
    """Solve the linear problem by CG with GAMG; return a row of the table."""
    beams = Beams(read_msh(path))
    comm = beams.scene.mesh.comm
    before = peak_memory(comm)
    timer, begin = Timer(), _now(comm)
    with timer.phase("assembly"):
        A = beams.stiffness()
        A.setOption(PETSc.Mat.Option.SPD, True)
        b = beams.load()
    with timer.phase("set-up"):
        nodes = beams.scene.V.tabulate_dof_coordinates()[: b.getLocalSize() // 3]
        points = b.duplicate()
        points.setBlockSize(3)
        points.array_w[:] = nodes.ravel()
        A.setNearNullSpace(PETSc.NullSpace().createRigidBody(points))
        ksp = PETSc.KSP().create(comm)
        ksp.setOperators(A)
        ksp.setType("cg")
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setTolerances(rtol=rtol, atol=0.0, max_it=2000)
        ksp.getPC().setType("gamg")
        known = PETSc.Options()
        for name, value in GAMG.items():
            if not known.hasName(name):
                known[name] = value
        ksp.setFromOptions()
        ksp.setUp()
    with timer.phase("solve"):
        x = b.duplicate()
        ksp.solve(b, x)
    seconds, processor = _now(comm) - begin
    if ksp.getConvergedReason() < 0:
        raise RuntimeError(f"CG did not converge: {ksp.getConvergedReason()}")
    return {
        "unknowns": b.getSize(),
        "iterations": ksp.getIterationNumber(),
        "seconds": seconds,
        "processor seconds": processor,
        "phases": timer.seconds,
        "bytes": peak_memory(comm),
        "bytes before": before,
        "residual": relative_residual(A, x, b, beams.fixed),
    }


def _now(comm: MPI.Comm) -> np.ndarray:
    """Return the wall time and the largest processor time of a rank, after a barrier."""
    comm.barrier()
    return np.array([time.perf_counter(), comm.allreduce(time.process_time(), MPI.MAX)])


def make_meshes(n: int, folder: Path) -> dict[str, Path]:
    """Write the mesh of the two beams, and the one with merged contact nodes."""
    from two_beams import two_beams

    paths = {kind: folder / f"{kind}_{n}.msh" for kind in ("contact", "glued")}
    if not all(path.exists() for path in paths.values()):
        two_beams(paths["contact"], "tetrahedron", n)
        glue(paths["contact"], paths["glued"])
    return paths


def glue(source: Path, target: Path) -> None:
    """Merge coincident nodes, and remove the tags of the contact surfaces."""
    import gmsh
    from gmsh_files import name_group, session

    with session():
        gmsh.open(str(source))
        names = {
            group: gmsh.model.getPhysicalName(*group) for group in gmsh.model.getPhysicalGroups()
        }
        kept = [
            (*group, name, gmsh.model.getEntitiesForPhysicalGroup(*group))
            for group, name in names.items()
            if name not in CONTACT
        ]
        gmsh.model.removePhysicalGroups()
        for dim, tag, name, entities in kept:
            name_group(dim, entities, name, tag)
        gmsh.model.mesh.removeDuplicateNodes()
        gmsh.option.setNumber("Mesh.MshFileVersion", 4.1)
        gmsh.write(str(target))


def run(
    elements_per_metre=(21, 35),
    residual=(1e-4, 1e-6),
    ranks=(1, 2),
    option=(),
    only="",
    meshes="",
    mesh="",
):
    """Solve on each mesh, to each residual, on each number of ranks.

    `only` one of the problems; `meshes` is a folder to keep the meshes in. With `mesh`, a file, one
    problem is solved in this process.
    """
    if mesh:
        (wanted,) = residual
        options = dict(one.split("=", 1) for one in option)
        contact = only == "contact"
        limit = RTOL_FACTOR * wanted
        yield solve_contact(mesh, limit, options) if contact else solve_glued(mesh, wanted)
        return
    kinds = [only] if only else ["glued", "contact"]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(meshes or temporary)
        for kind, path in make_meshes(WARM_UP, folder).items():
            separately("general", only=kind, mesh=path, residual=1e-4)
        cases = itertools.product(elements_per_metre, ranks, residual)
        for n, processes, wanted in cases:
            paths, linear = make_meshes(n, folder), None
            for kind in kinds:
                options = option if kind == "contact" else ()
                case = {"only": kind, "mesh": paths[kind], "residual": wanted, "option": options}
                (row,) = separately("general", processes, **case)
                linear = linear or row
                ratios = {
                    f"{name} of the first": row[name] / linear[name]
                    for name in ("seconds", "processor seconds")
                }
                yield {"kind": kind, "wanted": wanted, "ranks": processes, **row, **ratios}
