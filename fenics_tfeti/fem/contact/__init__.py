"""From facet tags to contact rows."""
