"""Where the products of a solve that has not converged went, and what to try next."""

from __future__ import annotations

from collections.abc import Mapping

from fenics_tfeti.feti.dual.iterate import Method, SolveStatus
from fenics_tfeti.feti.options import Options


def most_spent(spent: Mapping[Method, int]) -> str:
    """Say which method has spent most of the products.

    Examples
    --------
    >>> most_spent({Method.ACTIVE_SET: 900, Method.SMALBE: 100})
    'the active set method has spent 900 of 1000 products'
    """
    method = max(spent, key=spent.__getitem__)
    return f"{method.words} has spent {spent[method]} of {sum(spent.values())} products"


def next_attempt(
    status: SolveStatus, spent: Mapping[Method, int], options: Options, preconditioner: str
) -> str:
    """Return what to try next, with its option: a method or preconditioner that was not used.

    Fewer products than usual say nothing about the method.
    """
    if status not in (SolveStatus.OUT_OF_STEPS, SolveStatus.OUT_OF_PRODUCTS):
        return "Raise rtol"
    by_smalbe, attempt = 2 * spent.get(Method.SMALBE, 0) > sum(spent.values()), ""
    if options.max_products >= Options().max_products:
        if by_smalbe == (options.method == "smalbe"):
            other = Method.ACTIVE_SET if by_smalbe else Method.SMALBE
            attempt = f"method='{other.value}'"
        elif preconditioner == "lumped":
            attempt = "preconditioner='dirichlet'"
    return f"Try {attempt}, raise the limit or rtol" if attempt else "Raise the limit or rtol"
