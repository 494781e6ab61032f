"""From facet tags to contact rows: surfaces, pairs of nodes, normals and gaps."""
