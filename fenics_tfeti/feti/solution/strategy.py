"""Which method goes on after which, and what each may spend.

A pass of the outer loop runs methods until one has ended in a way that `_NEXT` does not name; then
the certificate of the iterate decides.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fenics_tfeti.feti.dual.iterate import Method, SolveStatus, Turn
from fenics_tfeti.feti.options import Options
from fenics_tfeti.feti.solution.monitor import Monitor
from fenics_tfeti.feti.solution.progress import Stagnation

End = tuple[Method, SolveStatus | Stagnation]

# (method, how it or its certificates ended): the method that goes on, None for that of the start
_NEXT: dict[End, Method | None] = {
    (Method.GRADIENTS, SolveStatus.STALLED): Method.ACTIVE_SET,
    (Method.ACTIVE_SET, SolveStatus.STALLED): Method.NEWTON,
    (Method.NEWTON, SolveStatus.CENTRED): Method.ACTIVE_SET,
    (Method.NEWTON, SolveStatus.STALLED): None,
    (Method.SMALBE, SolveStatus.STALLED): Method.ACTIVE_SET,
    # directions of U have no curvature: rounding of the gradient may have led there
    (Method.SMALBE, SolveStatus.FLAT): Method.ACTIVE_SET,
    # of certificates that are not small enough
    (Method.SMALBE, Stagnation.FINAL): Method.ACTIVE_SET,
    (Method.ACTIVE_SET, Stagnation.OF_ROUNDING): Method.SMALBE,
}
# ends after which the method that goes on does so once in an outer loop
_ONCE = (Method.SMALBE, SolveStatus.FLAT), (Method.SMALBE, Stagnation.FINAL)
# products of a turn after the first one, in the first round, doubled in each round
_SHARE = 2000


@dataclass
class Strategy:
    """The turns of the methods in the passes of one outer loop."""

    start: Method  # the one that the loop has begun with
    options: Options
    monitor: Monitor
    shares_first: bool  # whether the first turn of a pass has a share, too
    done: set[End]  # ends that have had their one turn
    outer_before: int  # outer iterations of SMALBE-M before this loop
    max_products: int  # limit on all products of the solve
    tolerance: float = 0.0  # of the pass [sqrt(J)]
    round: int = 0  # how often the method of the start has had its turn again in this pass
    is_later: bool = False  # whether a turn of the pass has ended
    # products that are left of the turns in which methods are
    left: dict[Method, int] = field(default_factory=dict)

    @staticmethod
    def of(
        start: Method, options: Options, monitor: Monitor, *, follows: bool, deflated: bool
    ) -> Strategy:
        """Return that of an outer loop; with bounds that follow the forces all turns are shares."""
        done: set[End] = set() if deflated else {(Method.SMALBE, SolveStatus.FLAT)}
        before, limit = len(monitor.history.outer), options.max_products
        return Strategy(start, options, monitor, follows, done, before, limit)

    @property
    def is_spent(self) -> bool:
        """Tell whether no product is left."""
        return self.monitor.history.products.total >= self.max_products

    def begin(self, tolerance: float) -> None:
        """Begin a pass."""
        self.tolerance, self.round, self.is_later = tolerance, 0, False
        self.left.clear()

    def turn(self, method: Method) -> Turn:
        """Return what a method may spend: in the first turn what is left, later a share."""
        options, history = self.options, self.monitor.history
        whole = not (self.is_later or self.shares_first)
        share = self.max_products if whole else _SHARE * 2**self.round
        limit = history.products.total + self.left.setdefault(method, share)
        return Turn(
            self.tolerance,
            min(self.max_products, limit),
            history.products,
            self.monitor.tell,
            options,
            max_outer=options.smalbe_max_it - (len(history.outer) - self.outer_before),
            patience=2**self.round * options.smalbe_patience,
        )

    def after(self, method: Method, ended: SolveStatus, spent: int) -> Method | None:
        """Return the method that goes on after one; None if the certificate has to decide.

        `spent` are the products of its turn.
        """
        self.left[method] -= spent
        if ended is SolveStatus.AT_ROUNDING and self.is_later:
            ended = SolveStatus.STALLED
        self.is_later = True
        if ended is SolveStatus.CENTRED:
            # Newton's turn is not over; a trial takes at most as many products as all before it
            total = self.monitor.history.products.total
            self.left[Method.ACTIVE_SET] = min(total, self.left[method])
        else:
            del self.left[method]
        return self._next(method, ended)

    def after_passes(self, method: Method) -> Method | None:
        """Return the method that goes on where passes no longer reduce the certificate."""
        return self._next(method, Stagnation.FINAL)

    def after_rounding(self, method: Method) -> Method:
        """Return the method that goes on where rounding has left too large a certificate.

        From then on as many products are left as were spent.
        """
        spent = self.monitor.history.products.total
        self.max_products = min(self.max_products, spent + max(spent, _SHARE))
        return self._next(method, Stagnation.OF_ROUNDING) or method

    def _next(self, method: Method, ended: SolveStatus | Stagnation) -> Method | None:
        if (method, ended) not in _NEXT or (method, ended) in self.done:
            return None
        if (method, ended) in _ONCE:
            self.done.add((method, ended))
        following = _NEXT[method, ended]
        if following is None:
            self.round += 1
        return following or self.start
