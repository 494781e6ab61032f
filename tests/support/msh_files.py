"""Small .msh files of version 2.2, and those of models of Gmsh."""

import signal
from contextlib import contextmanager

import pytest


@contextmanager
def gmsh_model(path, gdim, order=1):
    """Yield Gmsh for a new model, which is meshed and written in the end."""
    gmsh = pytest.importorskip("gmsh")
    handler = signal.getsignal(signal.SIGINT)  # Gmsh replaces it
    gmsh.initialize(readConfigFiles=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        yield gmsh
        gmsh.model.mesh.generate(gdim)
        gmsh.model.mesh.setOrder(order)
        gmsh.write(str(path))
    finally:
        gmsh.finalize()
        signal.signal(signal.SIGINT, handler)


SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
CUBE = SQUARE + [(x, y, 1) for x, y, _ in SQUARE]
TETRAHEDRON = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]

# Cell: its nodes, then the elements (Gmsh type, physical group, nodes): the cell and one facet.
CELLS = {
    "triangle": (SQUARE[:3], [(2, 4, (1, 2, 3)), (1, 9, (1, 2))]),
    "quadrilateral": (SQUARE, [(3, 4, (1, 2, 3, 4)), (1, 9, (1, 2))]),
    "tetrahedron": (TETRAHEDRON, [(4, 4, (1, 2, 3, 4)), (2, 9, (1, 2, 3))]),
    "hexahedron": (CUBE, [(5, 4, tuple(range(1, 9))), (3, 9, (1, 2, 3, 4))]),
}


def write_msh(path, points, elements, names=(), numbers=None):
    """Write a .msh file of version 2.2."""
    numbers = numbers or range(1, len(points) + 1)
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat"]
    lines += ["$PhysicalNames", str(len(names)), *names, "$EndPhysicalNames"]
    lines += ["$Nodes", str(len(points))]
    lines += [f"{k} {x} {y} {z}" for k, (x, y, z) in zip(numbers, points, strict=True)]
    lines += ["$EndNodes", "$Elements", str(len(elements))]
    for k, (kind, group, nodes) in enumerate(elements, start=1):
        entity = group or 77  # the geometric entity, with or without a physical group
        lines += [f"{k} {kind} 2 {group} {entity} " + " ".join(map(str, nodes))]
    path.write_text("\n".join([*lines, "$EndElements", ""]))
    return path


def write_cell(path, cell):
    points, elements = CELLS[cell]
    dim = 3 if "hedron" in cell else 2
    return write_msh(path, points, elements, [f'{dim} 4 "body"', f'{dim - 1} 9 "support"'])
