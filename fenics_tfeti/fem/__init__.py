"""From meshes, UFL forms and facet tags to a torn system; the only storey that uses dolfinx."""
