"""From the operators to multipliers and displacements with a certificate."""
