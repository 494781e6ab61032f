"""Newton's method for contact of bodies with finite strains."""
