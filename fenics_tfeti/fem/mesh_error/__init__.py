"""The error of the mesh: an estimate in the energy norm from tractions in equilibrium."""
