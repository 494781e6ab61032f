"""Newton's method for finite strains: states, steps, the load cases that they lead to."""
