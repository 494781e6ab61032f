"""Contact problems on a tape of dolfinx-adjoint, beside its other problems.

The optional package dolfinx-adjoint (0.4, with dolfinx 0.11 or later) records what is computed from
Functions, Constants and Dirichlet conditions of its own, and differentiates it as pyadjoint does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

from dolfinx.fem import Function

from fenics_tfeti.errors import InputError
from fenics_tfeti.fem.displacement import fill_owned
from fenics_tfeti.nonlinear import NonlinearContactProblem
from fenics_tfeti.problem import ContactProblem
from fenics_tfeti.typing import Vector


def solve(
    problem: ContactProblem | NonlinearContactProblem, supports: Sequence[Function] = ()
) -> Any:
    """Solve a contact problem, as a block of the working tape of pyadjoint. Collective.

    What it depends on are the Functions and Constants of dolfinx-adjoint in its forms, those that
    are prescribed displacements, and the conditions of ``dolfinx_adjoint.dirichletbc``. A later
    evaluation of the tape solves again with the values there, an adjoint is that of
    `problem.adjoint`, a tangent that of `problem.tangent`. There are no second derivatives.

    Parameters
    ----------
    problem : ContactProblem or NonlinearContactProblem
        A step that was accepted by `advance` is the start of later ones, and no part of the tape.
    supports : sequence of dolfinx_adjoint.Function
        Values of conditions of ``dolfinx.fem.dirichletbc``, which do not tell them.

    Returns
    -------
    dolfinx_adjoint.Function
        The displacement, on the space of `problem.u` [m].

    Raises
    ------
    ImportError
        dolfinx-adjoint is not installed.
    InputError
        Nothing in the problem is of dolfinx-adjoint, or nothing depends on one of the `supports`.

    Examples
    --------
    >>> E = dolfinx_adjoint.Function(DG0)  # doctest: +SKIP
    >>> u = tape.solve(ContactProblem(a, L, bcs=bcs, contacts=contacts))  # doctest: +SKIP
    >>> J = dolfinx_adjoint.assemble_scalar(ufl.inner(u, u) * ufl.dx)  # doctest: +SKIP
    >>> pyadjoint.ReducedFunctional(J, pyadjoint.Control(E)).derivative()  # doctest: +SKIP
    """
    pyadjoint, overloaded = _libraries()
    data = _recorded(problem, supports, pyadjoint.OverloadedType)
    is_annotated = pyadjoint.annotate_tape()
    with pyadjoint.stop_annotating():
        u = overloaded.Function(problem.u.function_space, name="u")
        _copy(problem.solve(), u)
    if is_annotated:
        block = _block_type()(problem, data)
        pyadjoint.get_working_tape().add_block(block)
        block.add_output(u.create_block_variable())
    return u


def _libraries() -> tuple[Any, Any]:
    """Return pyadjoint and dolfinx-adjoint."""
    try:
        import dolfinx_adjoint
        import pyadjoint
    except ImportError as error:
        raise ImportError(
            f"fenics_tfeti.tape needs dolfinx-adjoint: {error}. With dolfinx 0.11 or later, pip "
            "install 'pyadjoint-ad>=2026.9' h5py, and then pip install --no-deps dolfinx-adjoint "
            "fenicsx-compat"
        ) from None
    return pyadjoint, dolfinx_adjoint


def _recorded(problem: Any, supports: Sequence[Function], overloaded: type[Any]) -> list[Any]:
    """Return what the problem depends on that a tape records."""
    forms = problem._torn.torn.forms
    u = problem.u if problem._has_finite_strains else None
    given = [c for form in (forms.bilinear, forms.linear) for c in form.form.coefficients()]
    given = [*given, *supports, *problem.bcs]
    # a condition and its value are the same
    data = {_parameter(m): m for m in given if isinstance(m, overloaded)}
    data.pop(u, None)
    if not data:
        raise InputError(
            "nothing in the problem is on a tape: give its forms and supports Functions or "
            "Constants of dolfinx_adjoint"
        )
    return list(data.values())


def _copy(source: Any, target: Any) -> Any:
    target.x.array[:] = source.x.array
    return target


def _parameter(m: Any) -> Any:
    """Return the Function whose values a Function or a Dirichlet condition has."""
    return m if isinstance(m, Function) else m.g


@cache
def _block_type() -> type[Any]:
    pyadjoint, overloaded = _libraries()

    class ContactBlock(pyadjoint.Block):  # type: ignore[misc, name-defined]
        """The solution of a contact problem."""

        def __init__(self, problem: Any, data: Sequence[Any]) -> None:
            super().__init__()
            self._problem = problem
            for m in data:
                self.add_dependency(m, no_duplicates=True)

        def __str__(self) -> str:
            return type(self._problem).__name__

        @contextmanager
        def _solved(self) -> Iterator[Any]:
            """Give the problem, solved with the values that the tape has here."""
            data = [(v.output, v.saved_output) for v in self.get_dependencies()]
            # the values of Dirichlet conditions are set by blocks of their own
            pairs = [(m, saved) for m, saved in data if isinstance(m, Function)]
            kept = [m.x.array.copy() for m, _ in pairs]
            try:
                for m, saved in pairs:
                    _copy(saved, m)
                if not self._problem._is_current():
                    self._problem.solve()
                yield self._problem
            finally:
                for (m, _), values in zip(pairs, kept, strict=True):
                    m.x.array[:] = values

        def recompute_component(self, inputs: Any, variable: Any, idx: int, prepared: Any) -> Any:
            with self._solved() as problem:
                return _copy(problem.u, overloaded.Function(problem.u.function_space))

        def prepare_evaluate_adj(
            self, inputs: Any, adj_inputs: Any, relevant_dependencies: Any
        ) -> dict[int, Vector]:
            """Return the derivatives by the relevant dependencies, by their positions."""
            with self._solved() as problem:
                weights = _copy(adj_inputs[0], Function(problem.u.function_space))
                adjoint = problem.adjoint(weights)
                return {k: adjoint.by(_parameter(v.output)) for k, v in relevant_dependencies}

        def evaluate_adj_component(
            self, inputs: Any, adj_inputs: Any, variable: Any, idx: int, prepared: Any = None
        ) -> Any:
            derivative = overloaded.Function(_parameter(variable.output).function_space)
            return fill_owned(derivative, prepared[idx]).x

        def evaluate_tlm_component(
            self, inputs: Any, tlm_inputs: Any, variable: Any, idx: int, prepared: Any = None
        ) -> Any:
            pairs = zip(self.get_dependencies(), tlm_inputs, strict=True)
            changes = {
                _parameter(v.output): _parameter(change).x.array
                for v, change in pairs
                if change is not None
            }
            with self._solved() as problem:
                u = problem.tangent(changes).u
                return _copy(u, overloaded.Function(problem.u.function_space))

    return ContactBlock
