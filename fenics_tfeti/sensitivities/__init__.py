"""Derivatives of a solved ContactProblem on the face where the solve has ended.

With l and t the normal and friction forces, N and T the rows of unit length, and dJ the change of
a functional J(u, l, t) with the data,

    K z + N'a + T'b + D'rho = dJ/du,  N z = dJ/dl,  T z = dJ/dt where sites stick,  D z = o

on the closed rows N, and b = C T z where sites slip, with C = bound / |slip| across the force. Then

    dJ = z'(df - dK u) + a'dg + b'ds + rho'dv - (T z)'direction d(bound) + what J itself changes by.

With Coulomb's law the bound follows the normal force: N z + mu direction'T z = dJ/dl at sites that
slip, by GMRES with a linear solve a step. Where rows follow the displacement, `contact_derivative`
has what they change by.
"""
