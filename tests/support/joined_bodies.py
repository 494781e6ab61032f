"""Meshes whose bodies share the nodes of the interfaces between them."""

from mpi4py import MPI

import numpy as np
from msh_files import gmsh_model
from scenes import Scene, at, fixed, integral

import ufl
from dolfinx.mesh import meshtags

from fenics_tfeti.fem import _compat
from fenics_tfeti.fem.topology import cells_of_facets, facet_corners
from fenics_tfeti.io import Box, TaggedMesh, boxes, tag_facets

GDIM = {"triangle": 2, "quadrilateral": 2, "tetrahedron": 3, "hexahedron": 3}


def block(cell, body, comm=MPI.COMM_SELF, n=4, tagged=None):
    """Return a unit block with n cells an edge, and body(x) the tags of its cells.

    Its side x = 1 has the tag 7, and interior facets where `tagged` holds at their centre 9.
    """
    gdim = GDIM[cell]
    whole = boxes(comm, [Box((0,) * gdim, (1,) * gdim, (n,) * gdim)], cell)
    mesh = whole.mesh
    nodes = _compat.geometry_cells(mesh)
    number = np.arange(len(nodes), dtype=np.int32)
    values = body(mesh.geometry.x[nodes].mean(axis=1)).astype(np.int32)
    facets = tag_facets(mesh, {7: lambda x: np.isclose(x[0], 1.0)})
    found = dict(zip(facets.indices.tolist(), facets.values.tolist(), strict=True))
    if tagged is not None:
        index_map = mesh.topology.index_map(gdim - 1)
        every = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
        centres = mesh.geometry.x[facet_corners(mesh, *cells_of_facets(mesh, every))].mean(axis=1)
        found.update(dict.fromkeys(every[tagged(centres)].tolist(), 9))
    order = np.array(sorted(found), dtype=np.int32)
    tags = meshtags(mesh, gdim - 1, order, np.array([found[f] for f in order], dtype=np.int32))
    return TaggedMesh(mesh, meshtags(mesh, gdim, number, values), tags, {"side": 7})


def of_degree_two(cell, body, n=4):
    """Return the block with nodes on edges and faces as well, on one rank; no facet is tagged."""
    gdim = GDIM[cell]
    whole = boxes(MPI.COMM_SELF, [Box((0,) * gdim, (1,) * gdim, (n,) * gdim)], cell)
    space = _compat.lagrange_space(whole.mesh, 2)
    nodes, x = _compat.cell_dofs(space).astype(np.int64), space.tabulate_dof_coordinates()
    mesh = _compat.distributed_mesh(MPI.COMM_SELF, nodes, x[:, :gdim].copy(), cell, degree=2)
    cells = _compat.geometry_cells(mesh)
    values = body(mesh.geometry.x[cells].mean(axis=1)).astype(np.int32)
    none = np.zeros(0, dtype=np.int32)
    bodies = meshtags(mesh, gdim, np.arange(len(cells), dtype=np.int32), values)
    return TaggedMesh(mesh, bodies, meshtags(mesh, gdim - 1, none, none), {})


def halves(x):
    return np.where(x[:, 0] < 0.5, 1, 2)


def thirds(x):
    """Return 1 on the left, 2 and 3 on the right, which meet at (0.5, 0.5)."""
    return np.where(x[:, 0] < 0.5, 1, np.where(x[:, 1] < 0.5, 2, 3))


def middle(x):
    return np.isclose(x[:, 0], 0.5)


def vertices(tagged):
    return tagged.mesh.topology.index_map(0).size_global


def measure(tagged, kind, tag):
    data = tagged.cell_tags if kind == "dx" else tagged.facet_tags
    return integral(tagged.mesh, data, tag, kind)


def elasticity(tagged, press):
    """Return forms and supports of a block that is pressed against its other half along x."""
    gdim = tagged.mesh.geometry.dim
    planes = tag_facets(tagged.mesh, {k: at(k, 0.0) for k in range(gdim)})
    scene = Scene(tagged.mesh, tagged.facet_tags)
    scene.add_load(7, np.eye(gdim)[0] * -press)
    a = ufl.inner(ufl.sym(ufl.grad(scene.u)), ufl.sym(ufl.grad(scene.v))) * ufl.dx
    return a, scene.L, [fixed(scene.V, planes, axis, axis) for axis in range(gdim)]


def bolt_in_block(path, gdim, order=1):
    """Write a mesh of a block with a bolt through it, which share the nodes of the hole."""
    with gmsh_model(path, gdim, order) as gmsh:
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
        shapes = gmsh.model.occ
        if gdim == 3:
            plate = shapes.addBox(-2, -2, 0, 4, 4, 1)
            bolt = shapes.addCylinder(0, 0, -0.5, 0, 0, 2, 0.7)
        else:
            plate = shapes.addRectangle(-2, -2, 0, 4, 4)
            bolt = shapes.addDisk(0, 0, 0, 0.7, 0.7)
        _, made = shapes.fragment([(gdim, plate)], [(gdim, bolt)])
        shapes.synchronize()
        bolts = made[1]
        plates = [part for part in made[0] if part not in bolts]
        sides = [
            {tag for _, tag in gmsh.model.getBoundary(parts, oriented=False)}
            for parts in (plates, bolts)
        ]
        groups = [
            (gdim, [tag for _, tag in plates], "block"),
            (gdim, [tag for _, tag in bolts], "bolt"),
            (gdim - 1, sorted(sides[0] & sides[1]), "hole"),
            (gdim - 1, sorted(sides[0] - sides[1]), "outside"),
        ]
        for number, (dim, tags, name) in enumerate(groups, start=1):
            gmsh.model.addPhysicalGroup(dim, tags, number)
            gmsh.model.setPhysicalName(dim, number, name)
