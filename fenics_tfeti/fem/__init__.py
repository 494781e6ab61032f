"""From meshes, UFL forms and facet tags to a torn system; the only layer that imports dolfinx."""
